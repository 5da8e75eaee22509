"""Results of a finished stream or evaluation: the scene, pictures, metrics, and the report, a page of all of it."""

import dataclasses
import json
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ssplat_jax.core.atomic import write_atomic
from ssplat_jax.core.console import Reporter
from ssplat_jax.core.gaussians import Gaussians, scale_colors
from ssplat_jax.core.kept_programs import Kept
from ssplat_jax.core.numerics import evenly_spread
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.evaluation.cost import peak_memory
from ssplat_jax.evaluation.pictures import report_page
from ssplat_jax.evaluation.scoring import ViewScore, exposures_to_json, score_views
from ssplat_jax.runs.open_run import OpenRun
from ssplat_jax.scene_files.formats import ExportReport, save_gaussians
from ssplat_jax.storage.chunk_records import ChunkRecord, load_chunk_records
from ssplat_jax.storage.files import write_json
from ssplat_jax.storage.run_folder import RunFolder
from ssplat_jax.storage.weights import load_params, params_digest
from ssplat_jax.streaming.session import Exposures, middle_exposure

_jitted_scale_colors = Kept(scale_colors)

NUM_PICTURES = 8  # streamed views, evenly spread, that are rendered from the finished scene

MOST_PICTURES, MOST_CHUNKS = 12, 10
"""Pictures on a page and rows of its table; of more, evenly spread ones are shown."""

NOTE = "Left to right: the photograph, the rendered view, its depth (light near, dark far)."
SHOWN = "holes filled, at the exposure of the nearest streamed views"
LITERAL = "over black, at the one exposure of the scene, the median of its views"

DESCRIBED_FILES = (
    ("scene.ply", "the streamed scene, in the frame and units of the capture, at the middle exposure of its views"),
    ("refined.ply", "the refined scene, in the same frame"),
    ("metrics.json", "every figure of this page, and more"),
    ("views", "pictures of streamed views"),
    ("chunks", "a record of every chunk: cameras, exposures, time, occupancy"),
    ("deltas", "the changes of every chunk, for the viewer"),
    ("state.npz", "the saved stream, from which a stopped run continues"),
    ("split.json", "the frames that were streamed and scored"),
    ("index.json", "the same frames as an index file"),
)


def scene_to_show(gaussians: Gaussians, stream_frame: StreamFrame, exposures: Exposures) -> Gaussians:
    """Gaussians of the stream as a person gets them: in the capture's frame, at the middle exposure of the stream.

    The cache keeps the exposure of the first views, which may lie in the shade: at the median of all, no scene is too
    dark to look at.

    Args:
        gaussians: the scene, in the stream frame, at the exposure of the first views.
        stream_frame: the similarity between both frames; its offset becomes that of the result.
        exposures: exposures of the streamed frames.
    """
    scaled = _jitted_scale_colors(gaussians, middle_exposure(exposures).astype(np.float32))
    return stream_frame.gaussians_to_capture(scaled)


def save_scene(path: Path, gaussians: Gaussians, stream_frame: StreamFrame, exposures: Exposures) -> ExportReport:
    """Writes Gaussians of the stream as a person gets them (`scene_to_show`); the path's suffix names the format.

    Raises:
        StorageError: the file cannot be written.
    """
    return save_gaussians(path, scene_to_show(gaussians, stream_frame, exposures))


def finish_run(run: OpenRun, path: str, reporter: Reporter) -> int:
    """Writes the scene of a finished stream, pictures of some streamed views, the report, and the metrics.

    Returns the number of Gaussians in the scene file; `path` is the capture, as the user gave it.

    Raises:
        StorageError: a file cannot be written.
    """
    folder, stream_frame, capture = run.folder, run.stream_frame, run.capture
    folder.metrics.unlink(missing_ok=True)  # see `finished_scene`
    gaussians = run.session.gaussians()
    report = save_scene(folder.scene, gaussians, stream_frame, run.exposures)
    if report.warning is not None:
        reporter.warn(f"{folder.scene.name}: {report.warning}")
    reporter.say(f"{folder.scene} is written; pictures and figures follow")
    folder.clear_views()
    frames = shown_frames(run.indices)
    scores = score_views(gaussians, capture, frames, stream_frame, run.exposures, picture=folder.view)
    middle = capture.camera(run.indices[len(run.indices) // 2], stream_frame)
    metrics = {
        "capture": capture.name,
        "size": [capture.width, capture.height],
        "views": run.num_views,
        "exposures": exposures_to_json(run.exposures),
        "scene_exposure": middle_exposure(run.exposures).tolist(),  # of scene.ply, relative to the first views
        "seen_views": list(map(dataclasses.asdict, scores)),  # of streamed views: how well the scene explains its input
        "ply": dataclasses.asdict(report),
        "compile_s": round(run.session.compile_seconds, 2),
        "step_memory_bytes": run.session.step_memory_bytes,  # None if all views were streamed before this call
        "peak_memory_bytes": peak_memory(run.session, middle)["peak_memory_bytes"],
        "cache": run.session.cache_facts(),
        "stream_frame": stream_frame.to_dict(),
        "config_hash": run.session.model.config.hash,
        "hpda": run.session.model.config.is_anchored,
    }
    report_run(folder, metrics, path, run.weights)
    write_json(folder.metrics, metrics)
    return report.num_written


def shown_frames(indices: Sequence[int]) -> list[int]:
    """A few of the frames, evenly spread."""
    return [indices[k] for k in evenly_spread(len(indices), NUM_PICTURES)]


def finished_scene(folder: RunFolder, num_views: int) -> int | None:
    """Gaussians in the scene that a finished run of `num_views` views left in `folder`; None if there is no such run.

    The metrics are written last: with them, everything is there.
    """
    if not (folder.scene.exists() and folder.metrics.exists()):
        return None
    try:
        metrics = json.loads(folder.metrics.read_text())
        return metrics["ply"]["num_written"] if metrics["views"] == num_views else None
    except (ValueError, KeyError, TypeError):  # edited, or of another command: write it again
        return None


def report_run(
    folder: RunFolder, metrics: dict[str, Any], path: str, weights: str, refined: list[ViewScore] | None = None
) -> None:
    """Writes the report of a run, whose folder is complete but for it and the metrics.

    Args:
        folder: the folder of the run.
        metrics: its metrics.
        path: the capture, as the user gave it.
        weights: digest of the weights that streamed it.
        refined: scores of the same views after a refinement, whose pictures lie in the folder; None without one.
    """
    records, streamed = load_chunk_records(folder.chunk_record_files()), metrics["seen_views"]
    scores = streamed if refined is None else [dataclasses.asdict(score) for score in refined]
    width, height = metrics["size"]
    mean_shown = lambda scores: f"{np.mean([score['shown']['psnr'] for score in scores]):.2f} dB"  # noqa: E731
    facts = [
        ("views streamed", f"{metrics['views']}"),
        ("Gaussians in the scene", f"{metrics['ply']['num_written']:,}"),
        (f"streamed views as shown, mean of {len(scores)}", mean_shown(scores)),
    ]
    if refined is not None:
        facts.append(("the same before refinement", mean_shown(streamed)))
    if records:
        facts.append(("a chunk, median", f"{np.median([r.seconds for r in records]):.2f} s"))
        facts.append(("of the cache in use", f"{records[-1].occupancy:.0%}"))
    weights = "" if weights == params_digest(load_params("tiny")) else " --weights WEIGHTS"
    out, capture, film = map(shlex.quote, (str(folder.path), path, f"{folder.path}_film"))
    commands = [
        f"ssplat view {out}    # in a browser",
        f"ssplat refine {out} {capture} --steps 200 --overwrite{weights}    # more steps of refinement, anew",
        f"ssplat render {out} {capture} --size {width}x{height} --film 8 --out {film}    # a film",
        f"ssplat export {out} --to scene.sog{weights}    # for other viewers, at an eighth of the size",
    ]
    _write_report(
        folder,
        metrics,
        [(folder.view(score["frame"]), _caption(score, "streamed")) for score in scores],
        summary=f"A scene of 3D Gaussians from {metrics['views']} views of {width} x {height} pixels, streamed once"
        f"{' and refined' if refined else ''}.",
        facts=facts,
        pictures_note=f"{NOTE} Scores of views that the scene was made from, {SHOWN}.",
        stream=_stream_rows(records),
        commands=commands,
    )


def report_eval(folder: RunFolder, metrics: dict[str, Any]) -> None:
    """Writes the report of an evaluation, whose folder is complete but for it."""
    shown, literal = metrics["shown"], metrics["literal"]
    facts = [
        ("PSNR as shown", f"{shown['psnr']:.2f} dB"),
        ("SSIM as shown", f"{shown['ssim']:.3f}"),
        *([] if shown["lpips"] is None else [("LPIPS as shown", f"{shown['lpips']:.3f}")]),
        ("PSNR, literal", f"{literal['psnr']:.2f} dB"),
        ("PSNR of copying the nearest view", f"{metrics['baselines']['nearest_view_psnr']:.2f} dB"),
        ("a chunk, median", f"{metrics['chunk_ms']['median']:.0f} ms"),
        ("Gaussians in the scene", f"{metrics['num_gaussians']:,}"),
    ]
    if refined := metrics.get("refinement"):
        facts.append(("PSNR as shown, before refinement", f"{refined['before']['shown']['psnr']:.2f} dB"))
    _write_report(
        folder,
        metrics,
        [(folder.target(score["frame"]), _caption(score, "unseen")) for score in metrics["per_view"]],
        summary=f"{metrics['target_views']} views that were never streamed, rendered from a scene of"
        f" {metrics['context_views']} other views.",
        facts=facts,
        pictures_note=f"{NOTE} Shown: {SHOWN}. Literal: {LITERAL}.",
    )


def _write_report(folder: RunFolder, metrics: dict[str, Any], pictures: list[tuple[Path, str]], **parts: Any) -> None:
    """Writes a page with these pictures and further parts."""
    found = metrics | metrics["cache"] | metrics["stream_frame"]
    figures = {name.replace("_", " "): x for name, x in found.items() if isinstance(x, str | int | float)}
    page = report_page(
        title=metrics["capture"],
        pictures=[pictures[k] for k in evenly_spread(len(pictures), MOST_PICTURES)],
        # A run writes its metrics after the report: with them, everything is there.
        files=[row for row in DESCRIBED_FILES if row[0] == folder.metrics.name or (folder.path / row[0]).exists()],
        details=[(name, f"{x:.6g}" if isinstance(x, float) else str(x)) for name, x in figures.items()],
        **parts,
    )
    write_atomic(folder.report, page.encode(errors="replace"))


def _stream_rows(records: Sequence[ChunkRecord]) -> list[tuple[str, ...]]:
    """Time, occupancy and scene size over the views streamed, below a header; empty without chunks."""
    rows = [("views", "time of a chunk", "cache in use", "Gaussians", "exposure (RGB)")]
    for k in evenly_spread(len(records), MOST_CHUNKS):
        r = records[k]
        exposure = " ".join(f"{factor:.2f}" for factor in np.mean([view.exposure for view in r.views], axis=0))
        rows.append((f"{r.num_views}", f"{r.seconds:.2f} s", f"{r.occupancy:.0%}", f"{r.num_gaussians:,}", exposure))
    return rows if records else []


def _caption(score: dict[str, Any], kind: str) -> str:
    """Frame and scores of a picture."""
    shown, literal = score["shown"], score["literal"]
    told = f"shown {shown['psnr']:.2f} dB, SSIM {shown['ssim']:.3f}"
    return f"{kind} frame {score['frame']} · {told} · literal {literal['psnr']:.2f} dB"
