"""Scene, pictures and metrics of a finished stream."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from ssplat_jax.core.console import Reporter
from ssplat_jax.core.gaussians import Gaussians, scale_colors
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.evaluation.cost import peak_memory
from ssplat_jax.evaluation.pictures import save_comparison
from ssplat_jax.evaluation.scoring import exposures_to_json, score_view
from ssplat_jax.runs.reports import report_run
from ssplat_jax.runs.resume import RunState
from ssplat_jax.scene_files.formats import ExportReport, save_gaussians
from ssplat_jax.storage.files import write_json
from ssplat_jax.storage.run_folder import RunFolder
from ssplat_jax.storage.weights import load_params, params_digest
from ssplat_jax.streaming.feed import Exposures, middle_exposure

NUM_PICTURES = 8
"""Streamed views, evenly spread, that are rendered from the finished scene."""


def finish_run(
    run: RunState, capture: Capture, path: str, indices: Sequence[int], folder: RunFolder, reporter: Reporter
) -> ExportReport:
    """Writes the scene, pictures of some streamed views, the report, and the metrics.

    Args:
        run: the finished stream.
        capture: the capture that was streamed.
        path: the capture, as the user gave it.
        indices: frames that were streamed, in the capture's order.
        folder: where the results go.
        reporter: prints warnings.

    Returns:
        What was written to the scene file.

    Raises:
        StorageError: a file cannot be written.
    """
    folder.metrics.unlink(missing_ok=True)  # see `finished_scene`
    gaussians, frame = run.session.gaussians(), run.frame
    report = save_scene(folder.scene, gaussians, frame, run.exposures)
    if report.warning is not None:
        reporter.warn(f"{folder.scene.name}: {report.warning}")
    folder.clear_views()
    shown = sorted({indices[round(i)] for i in np.linspace(0, len(indices) - 1, NUM_PICTURES)})
    scores = []
    for i in shown:
        view = score_view(gaussians, capture, i, frame, run.exposures)
        scores.append(dataclasses.asdict(view.score))
        save_comparison(folder.view(i), view.target, view.color, view.depth, (frame.near, frame.far))
    metrics = {
        "capture": capture.name,
        "size": [capture.width, capture.height],
        "views": len(indices),
        "exposures": exposures_to_json(run.exposures),
        "scene_exposure": middle_exposure(run.exposures).tolist(),  # of scene.ply, relative to the first views
        "seen_views": scores,  # of streamed views: how well the scene explains its input
        "ply": dataclasses.asdict(report),
        "compile_s": round(run.session.compile_seconds, 2),
        "step_memory_bytes": run.session.step_memory_bytes,  # None if all views were streamed before this call
        "peak_memory_bytes": peak_memory(run.session, capture.camera(shown[len(shown) // 2], frame)).bytes,
        "cache": run.session.cache_facts(),
        "stream_frame": frame.to_dict(),
        "config_hash": run.session.model.config.hash,
    }
    is_shipped = params_digest(run.session.params) == params_digest(load_params("tiny"))
    report_run(folder, metrics, path, weights="" if is_shipped else " --weights WEIGHTS")
    write_json(folder.metrics, metrics)
    return report


def forget_other_run(run: RunState, folder: RunFolder) -> None:
    """Removes the metrics and the refinement of an earlier run from the folder of a run that begins."""
    if run.num_views == 0:
        folder.metrics.unlink(missing_ok=True)
        folder.clear_refinement()


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


def scene_to_show(gaussians: Gaussians, frame: StreamFrame, exposures: Exposures) -> Gaussians:
    """Gaussians of the stream as a person gets them: in the capture's frame, at the middle exposure of the stream.

    Args:
        gaussians: the scene, in the stream frame, at the exposure of the first views.
        frame: the similarity between the capture's frame and the stream's.
        exposures: exposures of the streamed frames.

    Returns:
        The scene in the capture's frame, relative to the frame's offset.
    """
    factors = jnp.asarray(middle_exposure(exposures), jnp.float32)
    return frame.gaussians_to_capture(scale_colors(gaussians, factors), offset=frame.offset)


def save_scene(path: Path, gaussians: Gaussians, frame: StreamFrame, exposures: Exposures) -> ExportReport:
    """Writes Gaussians of the stream as a person gets them (`scene_to_show`).

    Args:
        path: the file to write; its extension names the format.
        gaussians: the scene, in the stream frame.
        frame: the similarity between the capture's frame and the stream's.
        exposures: exposures of the streamed frames.

    Returns:
        What was written.

    Raises:
        StorageError: the file cannot be written.
    """
    return save_gaussians(path, scene_to_show(gaussians, frame, exposures), offset=frame.offset)
