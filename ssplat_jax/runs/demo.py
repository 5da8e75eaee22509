"""`ssplat demo`: an embedded procedural scene, streamed with the shipped weights; what more views give, in numbers."""

import io
import time
from pathlib import Path

import numpy as np

from ssplat_jax.checkpoint.weights import load_params
from ssplat_jax.config import QUALITIES, Quality, preset
from ssplat_jax.data.capture import open_capture
from ssplat_jax.data.split import interleaved
from ssplat_jax.evaluation.evaluate import Exposures, cache_facts, exposures_of, save_comparison, save_image, score_view
from ssplat_jax.storage.atomic import write_atomic
from ssplat_jax.storage.folders import make_writable
from ssplat_jax.storage.json_files import write_json
from ssplat_jax.scene_files.ply import save_ply
from ssplat_jax.console import Reporter
from ssplat_jax.streaming.session import Session
from ssplat_jax.streaming.streamsplat import StreamSplat

STAGES = (4, 8, 16, 32, 64)  # views after which the scene is decoded and scored
NUM_FRAMES = 73  # 64 context views and the 9 interleaved targets between them


def run_demo(scene: str, out: Path, reporter: Reporter, quality: Quality = QUALITIES["accurate"]) -> dict:
    """Streams `procedural:scene`, scores the same targets after every stage, writes scene, pictures and metrics."""
    make_writable(out)  # before the long part
    since = time.perf_counter()
    model, params = StreamSplat(preset("tiny")), load_params("tiny")
    capture = open_capture(f"procedural:{scene}?frames={NUM_FRAMES}")
    streamed = capture.scaled(quality.scale)
    split = interleaved(len(capture), stride=1, context=STAGES[-1])
    frame = streamed.stream_frame(model.config, split.context)
    order = streamed.stream_order(model.config, split.context, frame)
    session = Session(model, params)
    rows, strip = [], []
    exposures: Exposures = {}
    with reporter.progress("streaming", STAGES[-1]) as advance:
        for chunk in streamed.chunks(model.config, order, frame=frame):
            exposures |= exposures_of(session.feed(chunk), chunk, order[len(exposures) :])
            advance(len(exposures))
            if len(exposures) in STAGES:
                row, middle = _score_stage(session, capture, split, frame, exposures)
                rows.append(row)
                strip.append(middle)
    gaussians = session.gaussians()
    save_ply(out / "scene.ply", frame.gaussians_to_capture(gaussians))
    for i in split.targets:
        _, color, depth = score_view(gaussians, capture, i, frame, exposures)
        save_comparison(out / f"view_{i:05d}.png", capture.image(i), color, depth, (frame.near, frame.far))
    middle_target = capture.image(split.targets[len(split.targets) // 2])
    save_image(out / "views_4_8_16_32_64_target.png", np.concatenate([*strip, middle_target], axis=1))
    metrics = {
        "scene": scene,
        "size": [capture.width, capture.height],
        "streamed_size": [streamed.width, streamed.height],
        "stages": rows,
        "cache": cache_facts(session),
        "compile_s": round(session.compile_seconds, 2),
        "seconds": round(time.perf_counter() - since, 1),
        "config_hash": model.config.hash,
    }
    write_json(out / "metrics.json", metrics)
    _plot(out / "quality.png", rows)
    header = ("views", "PSNR dB", "SSIM", "covered", "Gaussians")
    reporter.table(f"{scene}: quality of unseen views", header, [tuple(row.values()) for row in rows])
    return metrics


def _score_stage(session: Session, capture, split, frame, exposures: Exposures):
    """A row of the table, and the render of the middle target."""
    gaussians = session.gaussians()
    scored = [score_view(gaussians, capture, i, frame, exposures) for i in split.targets]
    scores = [score for score, _, _ in scored]
    row = {
        "views": len(exposures),
        "psnr": round(float(np.mean([s.psnr for s in scores])), 2),
        "ssim": round(float(np.mean([s.ssim for s in scores])), 3),
        "coverage": round(float(np.mean([s.coverage for s in scores])), 3),
        "num_gaussians": cache_facts(session)["decoded"],
    }
    return row, scored[len(scored) // 2][1]


def _plot(path: Path, rows: list[dict]) -> None:
    """PSNR against views; left out without matplotlib (the `plots` extra)."""
    try:
        import matplotlib

        matplotlib.use("Agg")
        from matplotlib import pyplot
    except ImportError:
        return
    figure, axes = pyplot.subplots(figsize=(5, 3.2), layout="constrained")
    axes.plot([r["views"] for r in rows], [r["psnr"] for r in rows], marker="o", color="#30507a")
    axes.set_xscale("log", base=2)
    axes.set_xticks([r["views"] for r in rows], [str(r["views"]) for r in rows])
    axes.set_xlabel("views seen")
    axes.set_ylabel("PSNR of unseen views, dB")
    axes.spines[["top", "right"]].set_visible(False)
    encoded = io.BytesIO()
    figure.savefig(encoded, dpi=150)
    pyplot.close(figure)
    write_atomic(path, encoded.getvalue())
