"""`ssplat run`: a capture into a scene, with the state on disk every few chunks so that a stopped run goes on."""

import dataclasses
from pathlib import Path

import numpy as np

from ssplat_jax.cache import grow
from ssplat_jax.checkpoint.delta_files import save_delta
from ssplat_jax.checkpoint.stream_state import load_newest_state, restore_previous, save_state
from ssplat_jax.checkpoint.weights import params_digest
from ssplat_jax.config import StreamConfig
from ssplat_jax.data.capture import Capture, open_capture
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.errors import InputError, StorageError, require_positive
from ssplat_jax.evaluation.evaluate import (
    Exposures,
    cache_facts,
    check_scorable,
    exposures_from_json,
    exposures_of,
    exposures_to_json,
    save_comparison,
    score_view,
)
from ssplat_jax.storage.atomic import previous_path
from ssplat_jax.storage.folders import remove_numbered
from ssplat_jax.scene_files.formats import check_format, save_gaussians
from ssplat_jax.storage.json_files import write_json
from ssplat_jax.storage.folder_lock import only_writer
from ssplat_jax.scene_files.export_rows import ExportReport
from ssplat_jax.streaming.scene_delta import SceneDelta, SceneFeed
from ssplat_jax.gaussians import Gaussians
from ssplat_jax.storage.interrupts import Interrupts
from ssplat_jax.console import Reporter
from ssplat_jax.streaming.session import Session
from ssplat_jax.streaming.streamsplat import StreamSplat

STATE_FILE, SCENE_FILE, METRICS_FILE = "state.npz", "scene.ply", "metrics.json"
PICTURES, PICTURE = "views", "#####.png"
DELTAS, DELTA = "deltas", "######.npz"  # <views so far>: the changes of one chunk
NUM_PICTURES = 8  # views of the stream, evenly spread, rendered from the finished scene


@dataclasses.dataclass(frozen=True)
class RunResult:
    """Where a run stands when `run_capture` returns."""

    num_views: int
    num_gaussians: int
    interrupted: int | None  # the signal that stopped it, if one did


def run_capture(
    model: StreamSplat,
    params: dict,
    path: str,
    out: Path,
    *,
    size: tuple[int, int] | None,
    scale: float = 1.0,
    stride: int,
    max_views: int | None,
    save_every: int,
    overwrite: bool,
    deltas: bool = False,
    reporter: Reporter,
) -> RunResult:
    """Streams the capture at `path` into `out`, continuing what stands there.

    Images are `scale` times `size` (default: their own). With `deltas`, what every chunk changed in the scene is
    written too, in the stream's frame (`checkpoint/delta_files.py`).

    Raises:
        InputError: the capture is unusable or lies in `out`, `out` holds a run of another capture or configuration, or
            another process is writing to it.
        StorageError: `out` cannot be written or its state is corrupt.
    """
    require_positive(stride=stride, save_every=save_every)
    if max_views is not None:
        require_positive(max_views=max_views)
    capture = open_capture(path, size=size).scaled(scale)
    check_scorable(capture)
    indices = list(range(0, len(capture), stride))[:max_views]
    capture.check_apart(out)
    capture.verify(indices)
    with only_writer(out):
        if overwrite:
            _forget(out)
        return _go_on(model, params, capture, indices, out, save_every, deltas, reporter)


def _forget(out: Path) -> None:
    """Removes the run that `out` holds."""
    for stale in (out / STATE_FILE, previous_path(out / STATE_FILE), out / SCENE_FILE, out / METRICS_FILE):
        stale.unlink(missing_ok=True)
    remove_numbered(out / DELTAS, DELTA)
    remove_numbered(out / PICTURES, PICTURE)


def _go_on(
    model: StreamSplat,
    params: dict,
    capture: Capture,
    indices: list[int],
    out: Path,
    save_every: int,
    deltas: bool,
    reporter: Reporter,
) -> RunResult:
    """Streams what the run in `out` has not had yet, and finishes it."""
    identity = _identity(model, params, capture, indices)
    session, frame, exposures = _resume(model, params, capture, indices, identity, out, reporter)
    done = len(exposures)
    if done == 0 or (done < len(indices) and not deltas):
        # Of a run that was stopped before its first save, whose changes are not those of this one; or of one that goes
        # on without telling more, whose changes would no longer add up to the scene.
        remove_numbered(out / DELTAS, DELTA)
    for warning in (*capture.notes, *filter(None, [frame.warning])):
        reporter.warn(warning)
    order = capture.stream_order(model.config, indices, frame)
    feed = None
    if deltas:
        # Without the changes up to here, the first delta is the whole scene: what the folder holds always adds up.
        is_told = done == 0 or _delta_path(out, done).exists()
        feed = SceneFeed(model, params, session.cache if is_told else None)
        if not is_told and done == len(indices) and session.cache is not None:
            _save_delta(out, done, feed.update(session.cache), frame)
    with Interrupts() as interrupts, reporter.progress("streaming", len(indices)) as advance:
        advance(done)
        if done < len(indices):
            for number, chunk in enumerate(capture.chunks(model.config, order[done:], frame=frame)):
                exposures |= exposures_of(session.feed(chunk), chunk, order[done:])
                done = len(exposures)
                if feed is not None and session.cache is not None:
                    _save_delta(out, done, feed.update(session.cache), frame)
                advance(done)
                stopped = interrupts.received  # read once: a signal may come at any time
                if stopped or (number + 1) % save_every == 0 or done == len(indices):
                    _save(session, frame, identity, exposures, out)
                if stopped:
                    break
        if stopped := interrupts.received:  # during the last save, too
            return RunResult(done, cache_facts(session)["decoded"], stopped)
    report = _finish(session, frame, capture, indices, exposures, out, reporter)
    return RunResult(done, report.num_written, None)


def export_run(run_dir: Path, to: Path, params: dict, reporter: Reporter) -> ExportReport:
    """Decodes the saved state of a run and writes its scene, in the capture's frame, to `to`.

    Of a damaged state the one saved before it is taken, which is said.

    Raises:
        InputError: no run there, a run with other weights, or `to` has the ending of no format.
        StorageError: the state is corrupt or `to` cannot be written.
    """
    check_format(to)
    state = run_dir / STATE_FILE
    if not state.exists() and not previous_path(state).exists():
        raise InputError(f"{run_dir}: wanted the folder of an `ssplat run`, found no {STATE_FILE} in it.")
    cache, header, damage = load_newest_state(state)
    if damage is not None:
        reporter.warn(f"{damage} Exporting the state saved before it, after {header['done']} views.")
    if header.get("weights") != params_digest(params):
        raise InputError(f"{run_dir}: was streamed with other weights than these; give the run's own with --weights.")
    session = Session(StreamSplat(StreamConfig.from_dict(header["config"])), params, cache)
    return _save_scene(to, session.gaussians(), StreamFrame.from_dict(header["frame"]))


def _save_scene(path: Path, gaussians: Gaussians, frame: StreamFrame) -> ExportReport:
    """Writes Gaussians of the stream in the capture's frame; far from its origin, from the frame's offset."""
    return save_gaussians(path, frame.gaussians_to_capture(gaussians, offset=frame.offset), offset=frame.offset)


def _delta_path(out: Path, done: int) -> Path:
    return out / DELTAS / f"{done:06d}.npz"


def _save_delta(out: Path, done: int, delta: SceneDelta, frame: StreamFrame) -> None:
    """A chunk's changes, and what a viewer needs to put them into the capture's frame."""
    save_delta(_delta_path(out, done), delta, {"frame": frame.to_dict(), "views": done})


def _identity(model: StreamSplat, params: dict, capture: Capture, indices: list[int]) -> dict:
    """What must be equal for a run to be continued."""
    return {
        "config": model.config.to_dict(),
        "capture": capture.name,
        "size": [capture.width, capture.height],
        "frames": indices,
        "poses": capture.digest(indices),
        "images": capture.images_digest(indices),
        "weights": params_digest(params),
    }


def _resume(
    model, params, capture: Capture, indices: list[int], identity: dict, out: Path, reporter: Reporter
) -> tuple[Session, StreamFrame, Exposures]:
    """The session that `out` holds, or a new one, and the exposures of the views that it has had.

    Of a damaged state the one saved before it, which is said.
    """
    state = out / STATE_FILE
    if not state.exists() and not previous_path(state).exists():
        return Session(model, params), capture.stream_frame(model.config, indices), {}
    cache, header, damage = load_newest_state(state)
    for name, value in identity.items():
        held = header.get(name)
        if name == "config":
            held, value = _what_counts(held or {}), _what_counts(value)
        if held != value:
            raise InputError(
                f"{out}: holds a run that differs in its {name} ({_difference(held, value)}); choose another --out,"
                " repeat the old options, or start anew with --overwrite."
            )
    if damage is not None:
        reporter.warn(f"{damage} Continuing from the state saved before it, after {header['done']} views.")
        restore_previous(state)
    if cache.capacity < model.config.memory.capacity:
        cache = grow(cache, model.config.memory.capacity)
    return (
        Session(model, params, cache),
        StreamFrame.from_dict(header["frame"]),
        exposures_from_json(header["exposures"]),
    )


def _what_counts(config: dict) -> dict:
    """Of a configuration, what a scene depends on: where no token is left out for want of room, not how much there is.

    So a run that stopped for want of room goes on with the remedy that it was given.
    """
    if config.get("overflow") not in ("grow", "error"):
        return config
    return {name: value for name, value in config.items() if name not in ("overflow", "capacity")}


def _difference(held, wanted) -> str:
    """The first difference of two JSON values, readable."""
    if isinstance(held, dict) and isinstance(wanted, dict):
        for name in sorted(held.keys() | wanted.keys()):
            if held.get(name) != wanted.get(name):
                return f"{name}: {held.get(name)!r} there, {wanted.get(name)!r} now"
    if isinstance(held, list) and isinstance(wanted, list) and len(held) > 4:
        return f"{len(held)} there, {len(wanted)} now, from {held[:2]} and {wanted[:2]} on"
    return f"{held!r} there, {wanted!r} now"


def _save(session: Session, frame: StreamFrame, identity: dict, exposures: Exposures, out: Path) -> None:
    assert session.cache is not None
    header = identity | {
        "frame": frame.to_dict(),
        "done": len(exposures),
        "exposures": exposures_to_json(exposures),
    }
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(f"{out}: cannot be made ({error.strerror}); choose another --out.") from error
    save_state(out / STATE_FILE, session.cache, header)


def _finish(
    session: Session,
    frame: StreamFrame,
    capture: Capture,
    indices: list[int],
    exposures: Exposures,
    out: Path,
    reporter: Reporter,
) -> ExportReport:
    """Scene, pictures and metrics of a finished stream."""
    gaussians = session.gaussians()
    report = _save_scene(out / SCENE_FILE, gaussians, frame)
    if report.warning is not None:
        reporter.warn(f"{SCENE_FILE}: {report.warning}")
    pictures = out / PICTURES
    remove_numbered(pictures, PICTURE)
    shown = sorted({indices[round(i)] for i in np.linspace(0, len(indices) - 1, NUM_PICTURES)})
    scores = []
    for i in shown:
        score, color, depth = score_view(gaussians, capture, i, frame, exposures)
        scores.append(dataclasses.asdict(score))
        save_comparison(pictures / f"{i:05d}.png", capture.image(i), color, depth, (frame.near, frame.far))
    metrics = {
        "capture": capture.name,
        "size": [capture.width, capture.height],
        "views": len(indices),
        "exposures": exposures_to_json(exposures),
        "seen_views": scores,  # of the stream itself: how well the scene explains its input
        "ply": dataclasses.asdict(report),
        "compile_s": round(session.compile_seconds, 2),
        "step_memory_bytes": session.step_memory_bytes,
        "cache": cache_facts(session),
        "stream_frame": frame.to_dict(),
        "config_hash": session.model.config.hash,
    }
    write_json(out / METRICS_FILE, metrics)
    return report
