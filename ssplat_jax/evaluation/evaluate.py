"""Quality and cost on one capture: stream the context, decode the cache, score views that were never streamed."""

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path

from ssplat_jax.core.atomic import write_atomic
from ssplat_jax.core.console import Reporter
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.split import Split, index_to_json
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.evaluation.cost import NUM_CHUNKS, measure_latency, peak_memory
from ssplat_jax.evaluation.metrics import SSIM_ARGUMENTS, LpipsWeights
from ssplat_jax.evaluation.pictures import save_comparison
from ssplat_jax.evaluation.scoring import (
    baselines,
    check_scorable,
    exposures_to_json,
    mean_scores,
    score_targets,
    score_view,
)
from ssplat_jax.poses.adjust_poses import adjust_and_say, check_look_ahead
from ssplat_jax.refinement import refine_on_capture
from ssplat_jax.storage.files import write_json
from ssplat_jax.storage.run_folder import RunFolder, make_writable
from ssplat_jax.streaming.feed import Exposures, feed_capture
from ssplat_jax.streaming.session import Session


def evaluate(
    session: Session,
    capture: Capture,
    split: Split,
    out: Path,
    reporter: Reporter | None = None,
    *,
    streamed: Capture | None = None,
    lpips_weights: LpipsWeights | None = None,
    refine_steps: int = 0,
    revise: str | None = None,
    scene: str | None = None,
) -> dict:
    """Streams, scores and times; writes metrics, split, index and a picture per target into `out`.

    A picture is target | render | depth. `split.json` holds the frames used, whose SHA-256 is in the metrics, and
    `index.json` holds them as an index file. Every frame is decoded once before anything is written, so that a damaged
    one leaves no partial result.

    Args:
        session: a new session with the model and its parameters.
        capture: the capture at the size at which views are scored.
        split: context frames to stream and target frames to score.
        out: folder of the results.
        reporter: shows progress and warnings; by default warnings only.
        streamed: the same capture at the size that is streamed; by default `capture`.
        lpips_weights: with them LPIPS is scored too; without, the fields `lpips` are null.
        refine_steps: refinement steps on the context views before the targets are scored. With them the metrics have a
            block `refinement`: the steps done, their seconds, and the scores before.
        revise: `poses` adjusts those of the context before it is streamed (`poses.adjust_poses`); targets keep theirs.
        scene: name in `index.json`; by default the capture's.

    Returns:
        The metrics as written.

    Raises:
        InputError: a frame is damaged or too small to be scored, the capture lies in `out`, `out` holds a run, or poses
            of a causal stream are to be adjusted.
        StorageError: `out` cannot be written.
    """
    folder, streamed, reporter = RunFolder(out), streamed or capture, reporter or Reporter(quiet=True)
    folder.check_no_run()
    check_look_ahead(revise, is_causal=session.model.config.stream.causal)
    check_scorable(capture, with_lpips=lpips_weights is not None)
    capture.check_output_folder(out)
    capture.verify((*split.context, *split.targets))
    make_writable(out)  # before the long part
    folder.clear_targets()  # they may be of another split
    adjusted = adjust_and_say(streamed, split.context, reporter) if revise else None
    if adjusted is not None:  # poses of the context alone
        capture, streamed = (dataclasses.replace(x, frames=adjusted.capture.frames) for x in (capture, streamed))
    stream_frame = streamed.stream_frame(session.model.config, split.context)
    reporter.warn_all(*capture.notes, stream_frame.warning)
    reference = baselines(capture, split)
    with reporter.progress("streaming", len(split.context)) as advance:
        exposures, recent = feed_capture(
            session,
            streamed,
            split.context,
            stream_frame,
            keep_order=split.keeps_order,
            num_recent=NUM_CHUNKS,
            on_chunk=advance,
        )
    cost = {  # before the latency is measured, for which the cache may grow and a step be compiled
        "compile_s": round(session.compile_seconds, 2),
        "compilations": session.num_compilations,
        "step_memory_bytes": session.step_memory_bytes,
        "refine_memory_bytes": session.refine_memory_bytes,  # None without refinement while streaming
        "cache": (facts := session.cache_facts()),
        "num_gaussians": facts["decoded"],
    }
    gaussians, refinement = session.gaussians(), {}
    if refine_steps:
        before = score_targets(gaussians, capture, split.targets, stream_frame, exposures, lpips_weights)
        gaussians, done = _refine(gaussians, streamed, split.context, stream_frame, exposures, refine_steps, reporter)
        cost["num_gaussians"] = int((gaussians.opacities > 0).sum())
        refinement = {"refinement": {**done, "before": before}}
    middle = capture.camera(split.targets[len(split.targets) // 2], stream_frame)
    cost["peak_memory_bytes"] = peak_memory(session, middle)["peak_memory_bytes"]
    scores = []
    for i in split.targets:
        view = score_view(gaussians, capture, i, stream_frame, exposures, lpips_weights)
        save_comparison(folder.target(i), view.target, view.color, view.depth, stream_frame.depth_range)
        scores.append(view.score)
    timing = measure_latency(session, recent, middle)
    metrics = {
        "capture": capture.name,
        "size": [capture.width, capture.height],
        "streamed_size": [streamed.width, streamed.height],
        "protocol": split.protocol,
        "split_sha256": split.sha256,
        "context_views": len(split.context),
        "target_views": len(split.targets),
        **mean_scores(scores),
        "ssim_arguments": SSIM_ARGUMENTS,
        "adjusted_poses": None if adjusted is None else adjusted.reason,
        **refinement,
        **timing,
        **cost,
        "config_hash": session.model.config.hash,
        "stream_frame": stream_frame.to_dict(),
        "baselines": reference,
        "exposures": exposures_to_json(exposures),
        "per_view": [dataclasses.asdict(s) for s in scores],
    }
    write_atomic(folder.split, split.to_json().encode())
    write_json(folder.index, index_to_json({scene or capture.name: split}))
    write_json(folder.metrics, metrics)
    return metrics


def _refine(
    gaussians: Gaussians,
    streamed: Capture,
    context: Sequence[int],
    stream_frame: StreamFrame,
    exposures: Exposures,
    steps: int,
    reporter: Reporter,
) -> tuple[Gaussians, dict]:
    """The scene refined on its context views, and what that took."""
    start = time.perf_counter()
    with reporter.progress("refining", steps) as advance:
        on_step = lambda step, loss: advance(step, f"loss {loss:.4f}")  # noqa: E731
        refined, report = refine_on_capture(
            gaussians, streamed, context, stream_frame, exposures, steps=steps, on_step=on_step
        )
    done = {name: value for name, value in vars(report).items() if name not in ("losses", "held_back")}
    return refined, done | {"seconds": round(time.perf_counter() - start, 2)}
