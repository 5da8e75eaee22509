"""`ssplat run`: streams a capture into a scene, and saves the stream every few chunks so that it can be continued."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from ssplat_jax.core.console import WAITING, Reporter
from ssplat_jax.core.errors import refusal, require_positive
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.evaluation.scoring import check_scorable
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.poses.adjust_poses import check_look_ahead
from ssplat_jax.runs.chunk_recorder import ChunkRecorder, hold_back
from ssplat_jax.runs.finish_run import finish_run, finished_scene, forget_other_run
from ssplat_jax.runs.resume import RunState, resume_run, run_identity, save_run
from ssplat_jax.runs.run_poses import capture_to_stream
from ssplat_jax.storage.chunk_records import save_delta
from ssplat_jax.storage.interrupts import Interrupts
from ssplat_jax.storage.run_folder import RunFolder, lock_folder
from ssplat_jax.streaming.feed import feed_chunks, middle_exposure
from ssplat_jax.streaming.scene_delta import SceneFeed


@dataclasses.dataclass(frozen=True)
class RunResult:
    """State of a run when `run_capture` returns."""

    num_views: int
    num_gaussians: int
    interrupted: int | None  # the signal that stopped it, if one did
    was_finished: bool = False  # the folder held it already; nothing was streamed or written


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
    num_held_back: int = 0,
    revise: str | None = None,
    reporter: Reporter,
) -> RunResult:
    """Streams a capture into a folder, continuing the run that the folder holds.

    Args:
        model: the model to run.
        params: the model's parameters.
        path: the capture, as `open_capture` takes it.
        out: folder of the results.
        size: (width, height) of the images; by default the capture's own.
        scale: factor of `size` at which images are streamed.
        stride: every `stride`-th frame is streamed.
        max_views: stop after this many frames.
        save_every: chunks between saved states.
        overwrite: remove the run that `out` holds and start anew.
        deltas: also write what each chunk changed in the scene, in the stream frame (`storage/delta_files.py`).
        num_held_back: frames, evenly spread, that are not streamed but scored every few chunks.
        revise: `poses` or `auto` adjusts the poses before the stream, see `run_poses.capture_to_stream`.
        reporter: shows progress and warnings.

    Raises:
        InputError: the capture is unusable or lies in `out`, fewer than two frames are to be streamed, too many frames
            are held back, poses of a causal stream are to be adjusted, `out` holds a run of another capture or
            configuration, or another process is writing to it.
        StorageError: `out` cannot be written or its state is corrupt.
    """
    require_positive(stride=stride, save_every=save_every)
    check_look_ahead(revise, is_causal=model.config.stream.causal)
    if max_views is not None:
        require_positive(max_views=max_views)
    capture = open_capture(path, size=size)
    if scale != 1.0:  # as `refine` and `export` will open it, by the size: a procedural capture is rendered for it
        scaled = capture.scaled(scale)
        capture = open_capture(path, size=(scaled.width, scaled.height))
    check_scorable(capture)
    taken = list(range(0, len(capture), stride))[:max_views]
    check_num_frames(len(taken), str(path))
    indices, held_back = hold_back(taken, num_held_back)
    capture.check_output_folder(out)
    capture.verify([*indices, *held_back])
    folder = RunFolder(out)
    with lock_folder(out):
        if overwrite:
            folder.clear_run()
        capture = capture_to_stream(capture, indices, revise, folder, reporter)
        recorder = ChunkRecorder(capture, folder, held_back)
        identity = run_identity(model, params, capture, indices)
        run = resume_run(model, params, capture, identity, folder, reporter)
        forget_other_run(run, folder)
        reporter.warn_all(*capture.notes, run.frame.warning)
        writer = start_deltas(run, len(indices), folder, deltas)
        if run.num_views == len(indices) and (num_written := finished_scene(folder, len(indices))) is not None:
            return RunResult(run.num_views, num_written, None, was_finished=True)
        stopped = _stream(run, capture, indices, identity, folder, recorder, writer, save_every, reporter)
        if stopped:
            return RunResult(run.num_views, int(run.session.cache_facts()["decoded"]), stopped)
        report = finish_run(run, capture, path, indices, folder, reporter)
    return RunResult(run.num_views, report.num_written, None)


def check_num_frames(count: int, path: str) -> None:
    """Refuses a stream of one frame, which tells no depth.

    Raises:
        InputError: `count` is below 2; the message names `path`, the capture.
    """
    if count < 2:
        fix = "add frames, or choose a smaller --stride or a larger --max-views"
        raise refusal(path, wanted="two frames or more to stream", got=str(count), fix=fix)


class DeltaWriter:
    """Writes what changed in the scene since the last call, with the frame that a viewer needs to place it."""

    def __init__(self, run: RunState, folder: RunFolder, *, is_complete: bool) -> None:
        session = run.session
        self._folder = folder
        self._feed = SceneFeed(session.model, session.params, session.cache if is_complete else None)

    def write(self, run: RunState) -> None:
        assert run.session.cache is not None
        delta = self._feed.update(run.session.cache)
        path = self._folder.delta(run.num_views)
        exposure = middle_exposure(run.exposures).tolist()
        save_delta(path, delta, {"frame": run.frame.to_dict(), "views": run.num_views, "exposure": exposure})


def start_deltas(run: RunState, num_wanted: int, folder: RunFolder, deltas: bool) -> DeltaWriter | None:
    """Removes stale deltas, and returns the writer of the next ones if they are asked for.

    The deltas in the folder always add up to the scene: without those of the views so far, the next one is the whole
    scene.
    """
    done = run.num_views
    if done == 0 or (done < num_wanted and not deltas):
        # Left by a run that stopped before its first save, or about to miss the changes of this one.
        folder.clear_deltas()
    for path in folder.delta_files():  # of chunks that will be streamed again, perhaps with other views
        if int(path.stem) > done:
            path.unlink(missing_ok=True)
    if not deltas:
        return None
    is_complete = done == 0 or folder.delta(done).exists()
    writer = DeltaWriter(run, folder, is_complete=is_complete)
    if not is_complete and done == num_wanted:
        writer.write(run)
    return writer


def _stream(
    run: RunState,
    capture: Capture,
    indices: Sequence[int],
    identity: dict,
    folder: RunFolder,
    recorder: ChunkRecorder,
    deltas: DeltaWriter | None,
    save_every: int,
    reporter: Reporter,
) -> int | None:
    """Streams the views that the run has not had yet; returns the signal that stopped it, if one did."""
    order = capture.stream_order(run.session.model.config, indices, run.frame)
    with Interrupts(has_work=False) as interrupts, reporter.progress("streaming", len(indices)) as advance:
        advance(run.num_views, WAITING)
        recorder.start(run)
        chunks = feed_chunks(run.session, capture, order[run.num_views :], run.frame)
        for number, fed in enumerate(chunks, start=1):
            interrupts.has_work = True
            run.exposures |= fed.exposures
            run.frame = fed.frame
            if deltas is not None:
                deltas.write(run)
            recorder.record(run, fed, is_last=run.num_views == len(indices))
            advance(run.num_views)
            stopped = interrupts.received  # read once: a signal may come at any time
            if stopped or number % save_every == 0 or run.num_views == len(indices):
                save_run(run, identity, folder)
            if stopped:
                break
        return interrupts.received  # a signal may have come during the last save, too
