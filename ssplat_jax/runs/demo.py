"""`ssplat demo`: streams an embedded procedural scene and scores unseen views after more and more streamed views."""

import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ssplat_jax.config import QUALITIES, Quality, preset
from ssplat_jax.core.console import Reporter
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.data.split import Split, interleaved_split
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.evaluation.pictures import import_pyplot, save_comparison, save_figure, save_image
from ssplat_jax.evaluation.scoring import ScoredView, mean_scores, score_view
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.refinement import Refinement, refine_on_capture
from ssplat_jax.runs.finish_run import save_scene
from ssplat_jax.storage.files import write_json
from ssplat_jax.storage.run_folder import RunFolder, make_writable
from ssplat_jax.storage.weights import load_params
from ssplat_jax.streaming.feed import Exposures, feed_chunks
from ssplat_jax.streaming.session import Session

STAGES = (4, 8, 16, 32, 64)
"""Numbers of streamed views after which the scene is decoded and scored."""


def run_demo(scene: str, out: Path, reporter: Reporter, quality: Quality = QUALITIES["accurate"]) -> dict:
    """Streams `procedural:scene` and scores the same targets after every stage.

    Args:
        scene: name of the procedural scene.
        out: folder of the scene, the pictures and the metrics.
        reporter: shows progress and the table.
        quality: size at which images are streamed (they are scored at full size), and the refinement steps afterwards,
            which add a row.

    Returns:
        The metrics as written.

    Raises:
        InputError: `out` holds a run.
        StorageError: `out` cannot be written.
    """
    folder, since = RunFolder(out), time.perf_counter()
    folder.check_no_run()
    make_writable(out)  # before the long part
    folder.clear_refinement()  # of an earlier demo
    model, params = StreamSplat(preset("tiny")), load_params("tiny")
    capture = open_capture(f"procedural:{scene}")  # 64 context views and the 9 interleaved targets between them
    streamed = capture.scaled(quality.scale)
    split = interleaved_split(len(capture), stride=1, context=STAGES[-1])
    frame = streamed.stream_frame(model.config, split.context)
    session = Session(model, params)
    exposures: Exposures = {}
    rows, strip, views = [], [], []
    with reporter.progress("streaming", STAGES[-1]) as advance:
        for fed in feed_chunks(session, streamed, streamed.stream_order(model.config, split.context, frame), frame):
            exposures |= fed.exposures
            advance(len(exposures))
            if len(exposures) in STAGES:
                gaussians = session.gaussians()
                views = [score_view(gaussians, capture, i, frame, exposures) for i in split.targets]
                rows.append(_table_row(views, len(exposures), session))
                strip.append(views[len(views) // 2].color)
    save_scene(folder.scene, session.gaussians(), frame, exposures)
    refined = {}
    if quality.refine_steps:
        better, report = _refine(session.gaussians(), streamed, split, frame, exposures, quality.refine_steps, reporter)
        save_scene(folder.refined_scene, better, frame, exposures)
        views = [score_view(better, capture, i, frame, exposures) for i in split.targets]
        refined = {"refined": {"steps": report.num_steps, **_table_row(views, len(exposures), session)}}
    for view in views:  # of the finished scene
        save_comparison(folder.target(view.score.frame), view.target, view.color, view.depth, (frame.near, frame.far))
    strip.append(views[len(views) // 2].target)
    save_image(out / "views_4_8_16_32_64_target.png", np.concatenate(strip, axis=1))
    metrics = {
        "scene": scene,
        "size": [capture.width, capture.height],
        "streamed_size": [streamed.width, streamed.height],
        "stages": rows,
        **refined,
        "cache": session.cache_facts(),
        "compile_s": round(session.compile_seconds, 2),
        "seconds": round(time.perf_counter() - since, 1),
        "config_hash": model.config.hash,
        "stream_frame": frame.to_dict(),
    }
    write_json(folder.metrics, metrics)
    _plot(out / "quality.png", rows, reporter)
    header = ("views", "shown dB", "SSIM", "literal dB", "SSIM", "covered", "Gaussians")
    reporter.table(f"{scene}: quality of unseen views", header, [tuple(row.values()) for row in rows])
    if refined:
        row = refined["refined"]
        reporter.say(
            f"after {row['steps']} refinement steps: shown {row['shown_psnr']:.2f} dB {row['shown_ssim']:.3f},"
            f" literal {row['literal_psnr']:.2f} dB {row['literal_ssim']:.3f}; {folder.refined_scene}"
        )
    return metrics


def _refine(
    gaussians: Gaussians,
    streamed: Capture,
    split: Split,
    frame: StreamFrame,
    exposures: Exposures,
    steps: int,
    reporter: Reporter,
) -> tuple[Gaussians, Refinement]:
    """The scene refined on its context views, with a progress bar."""
    with reporter.progress("refining", steps) as advance:
        on_step = lambda step, loss: advance(step, f"loss {loss:.4f}")  # noqa: E731
        return refine_on_capture(gaussians, streamed, split.context, frame, exposures, steps=steps, on_step=on_step)


def _table_row(views: Sequence[ScoredView], num_streamed: int, session: Session) -> dict:
    """Mean scores after `num_streamed` views."""
    scores = mean_scores([view.score for view in views])
    return {
        "views": num_streamed,
        "shown_psnr": round(scores["shown"]["psnr"], 2),
        "shown_ssim": round(scores["shown"]["ssim"], 3),
        "literal_psnr": round(scores["literal"]["psnr"], 2),
        "literal_ssim": round(scores["literal"]["ssim"], 3),
        "coverage": round(float(np.mean([view.score.coverage for view in views])), 3),
        "num_gaussians": session.cache_facts()["decoded"],
    }


def _plot(path: Path, rows: list[dict], reporter: Reporter) -> None:
    """Plots PSNR against views, where matplotlib is installed."""
    if (pyplot := import_pyplot()) is None:
        reporter.say(f"no {path.name} without matplotlib; pip install 'ssplat-jax[plots]'")
        return
    figure, axes = pyplot.subplots(figsize=(5, 3.2), layout="constrained")
    axes.plot([r["views"] for r in rows], [r["shown_psnr"] for r in rows], marker="o", color="#30507a", label="shown")
    axes.plot(
        [r["views"] for r in rows], [r["literal_psnr"] for r in rows], marker="o", color="#c06030", label="literal"
    )
    axes.legend(frameon=False)
    axes.set_xscale("log", base=2)
    axes.set_xticks([r["views"] for r in rows], [str(r["views"]) for r in rows])
    axes.set_xlabel("views seen")
    axes.set_ylabel("PSNR of unseen views, dB")
    axes.spines[["top", "right"]].set_visible(False)
    save_figure(path, figure)
