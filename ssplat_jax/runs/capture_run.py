"""`ssplat run`: streams a capture into a scene, chunk by chunk, into a folder from which a stopped run continues.

frames of a capture, or of a folder that is still being written -> chunks -> session -> records, deltas, saved states
-> scene, pictures, report, metrics
"""

import time
from collections.abc import Iterator

import numpy as np

from ssplat_jax.core.console import WAITING, Reporter
from ssplat_jax.core.errors import InputError, refusal, require_positive
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.open_capture import DONE, open_capture, open_growing, without_tilde
from ssplat_jax.data.readers.transforms_json import num_listed
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.poses.adjust_poses import check_look_ahead
from ssplat_jax.runs.open_run import OpenRun, open_run
from ssplat_jax.runs.run_results import finish_run, finished_scene
from ssplat_jax.runs.stream_commands import Run, stopped
from ssplat_jax.storage.chunk_records import ChunkRecord, RecordedView, make_thumbnail, save_chunk_record, save_delta
from ssplat_jax.storage.run_folder import Interrupts, RunFolder
from ssplat_jax.storage.saved_states import load_newest_state
from ssplat_jax.streaming.scene_delta import SceneFeed
from ssplat_jax.streaming.session import FedChunk, feed_chunks, middle_exposure

LARGE = 640 * 480  # pixels of an image above which a run says that smaller ones take less time
POLL_SECONDS = 0.25  # seconds between two looks at a folder that is still being written


def run_capture(model: StreamSplat, params: dict, options: Run, reporter: Reporter) -> int:
    """Streams a capture into a folder, continuing the run that the folder holds, and says so; returns the exit code.

    Images are decoded when their chunks are due, and kept from the depth range on while they fit in memory. A damaged
    one stops the stream there, with what came before it saved; once it is mended, the run continues.

    Args:
        model: the model to run; with a causal configuration if the capture is still being written.
        params: the model's parameters.
        options: the capture, the folder, the frames that are streamed, and what is written.
        reporter: shows progress and warnings.

    Raises:
        InputError: options or the capture are unusable, an image is damaged, or see `open_run`.
        StorageError: the folder cannot be written or its state is corrupt.
    """
    require_positive(**{x: getattr(options, x) for x in ("stride", "save_every", "max_views", "quiet_seconds")})
    check_look_ahead(is_asked=options.adjust_poses, is_causal=model.config.stream.causal)
    if not options.watch:
        with reporter.progress("opening", None, waiting=options.path, is_kept=False):
            source = WholeCapture(options)
        indices = source.indices
    else:
        source = GrowingCapture(options, reporter)
        chunk_size, folder, num_saved = model.config.stream.chunk_size, RunFolder(options.out), 0
        if folder.has_state() and not options.overwrite:
            num_saved = load_newest_state(folder.state)[1]["done"]
        if received := source.wait_for(max(num_saved, chunk_size)):
            return stopped(received, f"after {num_saved} views", overwrites=options.overwrite)
        indices = source.indices[: num_saved or chunk_size]
    kept = {"adjust_poses": options.adjust_poses, "overwrite": options.overwrite}
    with open_run(model, params, source.capture, indices, options.out, **kept, reporter=reporter) as run:
        num_before, width, height = run.num_views, run.capture.width, run.capture.height
        if options.size is None and width * height > LARGE:
            reporter.say(f"images are streamed at {width}x{height}; --size takes smaller ones in less time")
        if received := _stream(run, source, options, reporter):
            return stopped(received, f"after {run.num_views} views", overwrites=options.overwrite)
        num_finished = None
        if run.num_views > num_before:
            run.folder.clear_refinement()  # of a scene of fewer views
        else:
            num_finished = finished_scene(run.folder, run.num_views)
        num_gaussians = finish_run(run, options.path, reporter) if num_finished is None else num_finished
    scene = f"scene.ply ({num_gaussians} Gaussians from {run.num_views} views)"
    if num_finished is None:
        print(f"wrote {options.out}/{scene}; pictures and figures: {options.out}/report.html")
    else:
        print(f"{options.out} holds this run, finished: {scene}, views/, metrics.json; --overwrite starts it anew")
    return 0


def _stream(run: OpenRun, source: "WholeCapture | GrowingCapture", options: Run, reporter: Reporter) -> int | None:
    """Streams the views that the run has not had yet; returns the signal that stopped it, if one did."""
    deltas = DeltaWriter(run, is_wanted=options.deltas or options.view)
    with Interrupts(has_work=False) as interrupts, reporter.progress("streaming", source.total) as advance:
        if run.num_views:
            advance(run.num_views, WAITING)
        try:
            for number, fed in enumerate(source.chunks(run, interrupts), start=1):
                interrupts.has_work = True
                run.take(fed)
                deltas.write()
                record_chunk(run, fed)
                advance(run.num_views)
                every = options.save_every
                if time.monotonic() >= run.next_save if every is None else number % every == 0:
                    run.save()
                if interrupts.received:
                    break
        except InputError as error:
            run.save()
            if not run.num_views:
                raise
            how = f"{run.num_views} views are saved; mend it, and run again without --overwrite"
            raise InputError(f"{error} The stream stops here: {how}.") from error
        run.save()
        return interrupts.received  # read last: a signal may have come during the save, too


class WholeCapture:
    """The frames of a capture that is complete."""

    def __init__(self, options: Run) -> None:
        capture = open_capture(options.path, size=options.image_size)
        if options.scale != 1.0:
            # Opened anew, as `refine` and `export` will: a procedural capture renders other images for another size.
            scaled = capture.scaled(options.scale)
            capture = open_capture(options.path, size=(scaled.width, scaled.height))
        self.capture = capture
        self.indices = list(range(0, len(capture), options.stride or 1))[: options.max_views]
        check_num_frames(len(self.indices), options.path)
        self.total: int | None = len(self.indices)

    def chunks(self, run: OpenRun, interrupts: Interrupts) -> Iterator[FedChunk]:
        """Feeds the run the chunks that it has not had yet."""
        order = run.capture.stream_order(run.session.model.config, run.indices, run.stream_frame)
        yield from feed_chunks(run.session, run.capture, order[run.num_views :], run.stream_frame)


class GrowingCapture:
    """The frames of a folder that is still being written, in their order, as their images become complete.

    A frame that cannot be read yet holds back those after it. Nothing more will come once the folder holds a file
    `done`, or once for some seconds no frame has been listed and none has become complete.
    """

    def __init__(self, options: Run, reporter: Reporter) -> None:
        self._path, self._options, self._reporter = without_tilde(options.path), options, reporter
        self._opened: Capture | None = None
        self._most_listed = 0  # frames that the listing has had, complete or not
        self._last_change = time.monotonic()
        self._problem: str | None = None  # why no more frames are complete
        self.indices: list[int] = []  # frames whose images are complete
        self.has_ended = False
        self.total = options.max_views

    @property
    def capture(self) -> Capture:
        """The capture as it was at the last look.

        Raises:
            InputError: no frame is complete.
        """
        if self._opened is None or not self.indices:
            got, fix = self._problem or "none", "see that it is written there"
            raise refusal(str(self._path), wanted="a frame that can be read", got=got, fix=fix)
        return self._opened

    def wait_for(self, num_frames: int) -> int | None:
        """Waits for `num_frames` frames, or for the end; returns the signal that came meanwhile, if one did.

        Raises:
            InputError: at the end there was none, or one alone.
        """
        self._reporter.say(f"waiting for frames in {self._path}")
        with Interrupts(has_work=False) as interrupts:
            self.look()
            while not self.has_ended and len(self.indices) < num_frames and not interrupts.received:
                time.sleep(POLL_SECONDS)
                self.look()
            if interrupts.received:
                return interrupts.received
        check_num_frames(len(self.indices) if self.capture else 0, str(self._path))
        return None

    def chunks(self, run: OpenRun, interrupts: Interrupts) -> Iterator[FedChunk]:
        """Feeds the run chunks as they become complete, until nothing more will come or a signal does."""
        size = run.session.model.config.stream.chunk_size
        while not interrupts.received:
            num_waiting = len(self.indices) - run.num_views
            if num_waiting >= size or (self.has_ended and num_waiting > 0):
                run.capture, run.indices = self.capture, self.indices[: run.num_views + size]
                yield from feed_chunks(run.session, run.capture, run.indices[run.num_views :], run.stream_frame)
            elif self.has_ended:
                break
            else:
                time.sleep(POLL_SECONDS)
            if not self.has_ended:  # what comes after the end is for the next call, or each frame were a padded chunk
                self.look()
        if self._problem is not None and not interrupts.received and len(self.indices) != self._options.max_views:
            self._reporter.warn(f"{self._problem} It and the frames after it are left out.")

    def look(self) -> None:
        """Looks at the folder, and takes the frames that have become complete."""
        # Before the look: what was written before the file counts.
        said_so = ((self._path.parent if self._path.is_file() else self._path) / DONE).exists()
        if (listed := num_listed(self._path)) > self._most_listed:
            self._most_listed, self._last_change = listed, time.monotonic()
        capture, self._problem = open_growing(self._path, size=self._options.image_size)
        if capture is not None:
            self._take(capture.scaled(self._options.scale))
        is_full = self._options.max_views is not None and len(self.indices) >= self._options.max_views
        self.has_ended = said_so or is_full or time.monotonic() - self._last_change > self._options.quiet_seconds

    def _take(self, capture: Capture) -> None:
        """Adds the frames of a capture that have become complete."""
        if self._opened is not None and self.indices:
            old, new = (c.digest(self.indices) if len(c) > self.indices[-1] else "" for c in (self._opened, capture))
            if old != new:
                fix = "name frames so that new ones come last, and leave old ones as they are"
                raise refusal(str(self._path), wanted="frames added at the end", got="changes to earlier ones", fix=fix)
        if self._opened is None or len(capture) > len(self._opened):  # also frames that `stride` leaves out
            self._last_change = time.monotonic()
        self._opened = capture
        for i in list(range(0, len(capture), self._options.stride or 1))[len(self.indices) : self._options.max_views]:
            try:
                capture.verify([i])
            except InputError as error:  # being written
                self._problem = str(error)
                return
            self.indices.append(i)
            self._last_change = time.monotonic()


class DeltaWriter:
    """Writes what each chunk changed in the scene, with the frame that a viewer needs to place it.

    The deltas in the folder always add up to the scene: where those of the views so far are missing, the first one is
    the whole scene, and a chunk without a delta removes those before it.
    """

    def __init__(self, run: OpenRun, *, is_wanted: bool) -> None:
        if run.num_views == 0:
            run.folder.clear_deltas()  # left by a run that stopped before its first save
        is_complete = run.num_views == 0 or run.folder.delta(run.num_views).exists()
        self._run, self._feed = run, None
        if is_wanted:
            known = run.session.cache if is_complete else None
            self._feed = SceneFeed(run.session.model, run.session.params, known)
            if not is_complete:
                self.write()

    def write(self) -> None:
        """Writes the changes since the last call."""
        run = self._run
        if self._feed is None:
            run.folder.clear_deltas()
            return
        assert run.session.cache is not None  # a chunk has been fed
        exposure = middle_exposure(run.exposures).tolist()
        header = {"frame": run.stream_frame.to_dict(), "views": run.num_views, "exposure": exposure}
        save_delta(run.folder.delta(run.num_views), self._feed.update(run.session.cache), header)


def record_chunk(run: OpenRun, fed: FedChunk) -> None:
    """Writes the record of a chunk that the run has just taken in, for the viewer and the report."""
    facts, capture = run.session.cache_facts(), run.capture
    views = []
    for i, image in zip(fed.frames, np.asarray(fed.chunk.images), strict=False):  # without the padding
        pose, exposure = capture.frames[i].camtoworld, np.asarray(run.exposures[i], np.float64)
        views.append(RecordedView(i, pose, capture.K(i), exposure, make_thumbnail(image)))
    record = ChunkRecord(
        num_views=run.num_views,
        size=(capture.width, capture.height),
        views=tuple(views),
        seconds=round(fed.seconds, 4),
        occupancy=round(facts["voxels"] / facts["capacity"], 4),
        num_gaussians=int(facts["decoded"]),
    )
    save_chunk_record(run.folder.chunk_record(run.num_views), record)


def check_num_frames(count: int, path: str) -> None:
    """Refuses a stream of one frame, which tells no depth; the message names `path`, the capture."""
    if count < 2:
        fix = "add frames, or choose a smaller --stride or a larger --max-views"
        raise refusal(path, wanted="two frames or more to stream", got=str(count), fix=fix)
