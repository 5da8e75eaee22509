"""`ssplat demo`: streams an embedded procedural scene and scores unseen views after more and more streamed views."""

import time
from pathlib import Path

import numpy as np

from ssplat_jax.config import preset
from ssplat_jax.core.console import Reporter
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.data.open_capture import PROCEDURAL_SIZE, open_capture
from ssplat_jax.data.split import interleaved_split
from ssplat_jax.evaluation.pictures import save_comparison, save_image
from ssplat_jax.evaluation.scoring import ScoredView, mean_scores, score_view
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.runs.run_results import save_scene
from ssplat_jax.storage.files import write_json
from ssplat_jax.storage.run_folder import RunFolder
from ssplat_jax.storage.weights import load_params
from ssplat_jax.streaming.session import Exposures, Session, feed_chunks

SHOWN_PIVOTS = 1 << 16
"""Pivots that are decoded after every stage, as many as after the last: every number is a program to compile."""

STAGES = (4, 8, 16, 32, 64)
"""Numbers of streamed views after which the scene is decoded and scored."""


def run_demo(scene: str, out: Path, reporter: Reporter) -> dict:
    """Streams `procedural:scene` and scores the same targets after every stage.

    Args:
        scene: name of the procedural scene.
        out: folder of the scene, the pictures and the metrics.
        reporter: shows progress and the table.

    Returns:
        The metrics as written.

    Raises:
        InputError: `out` holds a run.
        StorageError: `out` cannot be written; who calls it has locked it, see `lock_folder`.
    """
    folder, since = RunFolder(out), time.perf_counter()
    folder.check_no_run()
    folder.clear_refinement()  # of an earlier command
    model, params = StreamSplat(preset("tiny")), load_params("tiny")
    session = Session(model, params)
    session.least_decoded = SHOWN_PIVOTS
    session.compile_ahead(*PROCEDURAL_SIZE, STAGES[-1])
    capture = open_capture(f"procedural:{scene}")  # 64 context views and the 9 interleaved targets between them
    split = interleaved_split(len(capture), stride=1, context=STAGES[-1])
    stream_frame = capture.stream_frame(model.config, split.context)
    order = capture.stream_order(model.config, split.context, stream_frame)
    exposures: Exposures = {}
    stages: list[tuple[Gaussians, Exposures, int]] = []
    with reporter.progress("streaming", STAGES[-1]) as advance:
        for fed in feed_chunks(session, capture, order, stream_frame):
            exposures = exposures | fed.exposures
            advance(len(exposures))
            if len(exposures) in STAGES:
                stages.append((session.gaussians(), exposures, int(session.cache_facts()["decoded"])))
    save_scene(folder.scene, stages[-1][0], stream_frame, exposures)
    reporter.say(f"{folder.scene} is written; pictures and figures follow")
    scored: list[list[ScoredView]] = []
    with reporter.progress("scoring", len(STAGES)) as advance:
        for gaussians, known, _ in reversed(stages):  # the program for the fullest scene serves all
            scored.insert(0, [score_view(gaussians, capture, i, stream_frame, known) for i in split.targets])
            advance(len(scored))
    rows = []
    for views, (_, known, num_gaussians) in zip(scored, stages, strict=True):
        scores, row = mean_scores([view.score for view in views]), {"views": len(known)}
        for kind in ("shown", "literal"):
            row |= {f"{kind}_psnr": round(scores[kind]["psnr"], 2), f"{kind}_ssim": round(scores[kind]["ssim"], 3)}
        coverage = round(float(np.mean([view.score.coverage for view in views])), 3)
        rows.append(row | {"coverage": coverage, "num_gaussians": num_gaussians})
    strip = [views[len(views) // 2].color for views in scored]
    for view in scored[-1]:
        save_comparison(folder.target(view.score.frame), view.target, view.color, view.depth, stream_frame.depth_range)
    strip.append(scored[-1][len(split.targets) // 2].target)
    save_image(out / "views_4_8_16_32_64_target.png", np.concatenate(strip, axis=1))
    metrics = {
        "scene": scene,
        "size": [capture.width, capture.height],
        "stages": rows,
        "cache": session.cache_facts(),
        "compile_s": round(session.compile_seconds, 2),
        "seconds": round(time.perf_counter() - since, 1),
        "config_hash": model.config.hash,
        "stream_frame": stream_frame.to_dict(),
    }
    write_json(folder.metrics, metrics)
    header = ("views", "shown dB", "SSIM", "literal dB", "SSIM", "covered", "Gaussians")
    reporter.table(f"{scene}: quality of unseen views", header, [tuple(row.values()) for row in rows])
    return metrics
