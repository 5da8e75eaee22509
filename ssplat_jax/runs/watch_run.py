"""`ssplat run --watch`: streams a folder that is still being written, chunk by chunk as its images become complete.

The stream is causal. Frames are taken in the order of the capture; a frame that cannot be read yet holds back those
after it. The run ends when the folder holds a file `done`, or when for some seconds no frame has been listed and none
has become complete; the last chunk is then padded. Frames that cannot be read at the end are left out, with a
warning.
"""

import dataclasses
import time
from pathlib import Path

from ssplat_jax.core.console import Reporter
from ssplat_jax.core.errors import InputError, refusal, require_positive
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.open_capture import is_done, open_growing, without_tilde
from ssplat_jax.data.readers.transforms_json import num_listed
from ssplat_jax.evaluation.scoring import check_scorable
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.runs.capture_run import DeltaWriter, RunResult, check_num_frames, start_deltas
from ssplat_jax.runs.chunk_recorder import ChunkRecorder
from ssplat_jax.runs.finish_run import finish_run, finished_scene, forget_other_run
from ssplat_jax.runs.resume import RunState, resume_run, run_identity, save_run
from ssplat_jax.runs.run_poses import forget_poses_without_run
from ssplat_jax.storage.interrupts import Interrupts
from ssplat_jax.storage.run_folder import RunFolder, lock_folder
from ssplat_jax.storage.saved_states import load_newest_state
from ssplat_jax.streaming.feed import feed_chunks

POLL_SECONDS = 0.25
"""Seconds between two looks at the folder."""


@dataclasses.dataclass(frozen=True)
class WatchOptions:
    """Frames of a growing capture that are streamed, and when the run ends."""

    size: tuple[int, int] | None = None  # (width, height) of the images; None for the capture's own
    scale: float = 1.0  # factor of `size` at which images are streamed
    stride: int = 1
    max_views: int | None = None
    quiet_seconds: float = 10.0  # without a new frame, after which the run ends
    save_every: int = 8  # chunks between saved states
    overwrite: bool = False
    deltas: bool = False


def watch_capture(
    model: StreamSplat, params: dict, path: str, out: Path, options: WatchOptions, reporter: Reporter
) -> RunResult:
    """Streams a capture while it is being written, continuing the run that the folder holds.

    Args:
        model: the model to run, with a causal configuration.
        params: the model's parameters.
        path: folder that holds, or will hold, a transforms.json.
        out: folder of the results.
        options: the frames that are streamed, and when the run ends.
        reporter: shows progress and warnings.

    Raises:
        InputError: nothing readable came, the capture lies in `out`, frames that were streamed have changed, or `out`
            holds a run of another capture or configuration.
        StorageError: `out` cannot be written or its state is corrupt.
    """
    counts = {"stride": options.stride, "save_every": options.save_every}
    require_positive(**counts, **({} if options.max_views is None else {"max_views": options.max_views}))
    if not options.quiet_seconds > 0:
        got, fix = str(options.quiet_seconds), "give a number of seconds"
        raise refusal("--quiet-seconds", wanted="a positive time", got=got, fix=fix)
    assert model.config.stream.causal
    watch = _Watch(model, params, without_tilde(path), RunFolder(out), options, reporter)
    with Interrupts(has_work=False) as interrupts:
        ended = watch.wait_for_frames(interrupts)
        if interrupts.received:
            return RunResult(watch.num_saved(), 0, interrupts.received)
        with lock_folder(out):
            if options.overwrite:
                watch.folder.clear_run()
            run = watch.begin()
            watch.stream(run, interrupts, ended)
            if interrupts.received:
                num_gaussians = int(run.session.cache_facts()["decoded"]) if run.num_views else 0
                return RunResult(run.num_views, num_gaussians, interrupts.received)
            indices = watch.indices[: run.num_views]
            if (num_written := finished_scene(watch.folder, len(indices))) is not None:
                return RunResult(run.num_views, num_written, None, was_finished=True)
            watch.folder.clear_refinement()  # of a scene of fewer views
            report = finish_run(run, watch.known(), path, indices, watch.folder, reporter)
    return RunResult(run.num_views, report.num_written, interrupts.received)


@dataclasses.dataclass
class _Watch:
    """The growing capture, and how much of it is complete."""

    model: StreamSplat
    params: dict
    path: Path
    folder: RunFolder
    options: WatchOptions
    reporter: Reporter
    capture: Capture | None = None
    indices: list[int] = dataclasses.field(default_factory=list)  # frames whose images are complete, in their order
    problem: str | None = None  # why no more frames are complete
    most_listed: int = 0  # frames that the listing has had, complete or not
    last_change: float = dataclasses.field(default_factory=time.monotonic)

    def known(self) -> Capture:
        """The capture; there is one once `wait_for_frames` has returned without a signal."""
        assert self.capture is not None
        return self.capture

    def num_saved(self) -> int:
        """Number of views of the run that the folder holds; 0 if it holds none."""
        return len(load_newest_state(self.folder.state)[1]["frames"]) if self.folder.has_state() else 0

    def look(self) -> bool:
        """Looks at the folder; returns whether nothing more is to be expected."""
        said_so = is_done(self.path)  # before the look: what was written before the file counts
        listed = num_listed(self.path)
        if listed > self.most_listed:
            self.most_listed, self.last_change = listed, time.monotonic()
        capture, self.problem = open_growing(self.path, size=self.options.size)
        if capture is not None:
            self._take(capture.scaled(self.options.scale))
        is_full = self.options.max_views is not None and len(self.indices) >= self.options.max_views
        return said_so or is_full or time.monotonic() - self.last_change > self.options.quiet_seconds

    def _take(self, capture: Capture) -> None:
        """Adds the frames of a capture that have become complete."""
        if self.capture is not None and self.indices:
            old, new = (c.digest(self.indices) if len(c) > self.indices[-1] else "" for c in (self.capture, capture))
            if old != new:
                fix = "name frames so that new ones come last, and leave old ones as they are"
                raise refusal(str(self.path), wanted="frames added at the end", got="changes to earlier ones", fix=fix)
        if self.capture is None or len(capture) > len(self.capture):  # also frames that `stride` leaves out
            self.last_change = time.monotonic()
        self.capture = capture
        for i in list(range(0, len(capture), self.options.stride))[len(self.indices) : self.options.max_views]:
            try:
                capture.verify([i])
            except InputError as error:  # being written
                self.problem = str(error)
                return
            self.indices.append(i)
            self.last_change = time.monotonic()

    def wait_for_frames(self, interrupts: Interrupts) -> bool:
        """Waits for a first chunk of frames, and for all that the saved run has had; returns whether no more will come.

        Raises:
            InputError: none came, or one alone.
        """
        needed = max(self.model.config.stream.chunk_size, 0 if self.options.overwrite else self.num_saved())
        self.reporter.say(f"waiting for frames in {self.path}")
        while not (ended := self.look()) and len(self.indices) < needed and not interrupts.received:
            time.sleep(POLL_SECONDS)
        if interrupts.received:
            return ended
        if not self.indices:
            got = self.problem or "none"
            raise refusal(
                str(self.path), wanted="a frame that can be read", got=got, fix="see that it is written there"
            )
        check_num_frames(len(self.indices), str(self.path))
        check_scorable(self.known())
        self.known().check_output_folder(self.folder.path)
        return ended

    def begin(self) -> RunState:
        """The run that the folder holds, or a new one."""
        forget_poses_without_run(self.folder)
        first = self.indices[: self.num_saved() or self.model.config.stream.chunk_size]
        identity = run_identity(self.model, self.params, self.known(), first)
        run = resume_run(self.model, self.params, self.known(), identity, self.folder, self.reporter)
        forget_other_run(run, self.folder)
        self.reporter.warn_all(*self.known().notes, run.frame.warning)
        return run

    def stream(self, run: RunState, interrupts: Interrupts, ended: bool) -> None:
        """Streams chunks as they become complete, until nothing more will come or a signal does."""
        size, num_chunks = self.model.config.stream.chunk_size, 0
        writer = start_deltas(run, run.num_views, self.folder, self.options.deltas)
        recorder = ChunkRecorder(self.known(), self.folder)
        recorder.start(run)
        while not interrupts.received:
            waiting = len(self.indices) - run.num_views
            if waiting >= size or (ended and waiting > 0):
                self._feed(run, self.indices[run.num_views :][:size], writer, recorder)
                interrupts.has_work, num_chunks = True, num_chunks + 1
                if num_chunks % self.options.save_every == 0:
                    self._save(run)
            elif ended:
                break
            else:
                time.sleep(POLL_SECONDS)
            ended = ended or self.look()  # what comes after the end is for the next call
        if num_chunks % self.options.save_every or interrupts.received:
            self._save(run)
        has_all = len(self.indices) == self.options.max_views
        if not interrupts.received and self.problem is not None and not has_all:
            self.reporter.warn(f"{self.problem} It and the frames after it are left out.")

    def _feed(self, run: RunState, group: list[int], writer: DeltaWriter | None, recorder: ChunkRecorder) -> None:
        recorder.capture = self.known()
        for fed in feed_chunks(run.session, self.known(), group, run.frame):
            run.exposures |= fed.exposures
            run.frame = fed.frame
            recorder.record(run, fed, is_last=False)
        if writer is None:
            self.folder.clear_deltas()  # they miss the changes of this chunk
        else:
            writer.write(run)
        self.reporter.say(f"{run.num_views} views streamed, {len(self.indices)} complete")

    def _save(self, run: RunState) -> None:
        if run.num_views:
            streamed = self.indices[: run.num_views]
            save_run(run, run_identity(self.model, self.params, self.known(), streamed), self.folder)
