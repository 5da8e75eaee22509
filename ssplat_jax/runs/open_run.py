"""A run and its folder: opened, checked, locked, identified, resumed and saved, with its adjusted poses.

    with open_run(model, params, capture, indices, out, reporter=reporter) as run:
        left = run.capture.stream_order(model.config, indices, run.stream_frame)[run.num_views :]
        for fed in feed_chunks(run.session, run.capture, left, run.stream_frame):  # streams each chunk
            run.take(fed)
            run.save()

A run is its configuration, frames, poses, intrinsics, images and weights. Continuing with any other is refused, and so
are the commands that come after it, because their results would mix two scenes.
"""

import contextlib
import dataclasses
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from ssplat_jax.cache.state import VoxelCache
from ssplat_jax.config import StreamConfig
from ssplat_jax.core.console import Reporter
from ssplat_jax.core.errors import InputError, StorageError, refusal
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.evaluation.scoring import check_scorable, exposures_from_json, exposures_to_json
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.poses.adjust_poses import adjust_and_say
from ssplat_jax.refinement import online_refinement
from ssplat_jax.storage.files import load_arrays, save_arrays
from ssplat_jax.storage.run_folder import RunFolder, lock_folder
from ssplat_jax.storage.saved_states import check_same, load_newest_state, restore_previous, save_state
from ssplat_jax.storage.weights import params_digest
from ssplat_jax.streaming.session import Exposures, FedChunk, Session, begin_stream

SAVE_SECONDS, SAVE_SHARE = 30.0, 0.1
"""Seconds between two saves of a stream, or more, so that saving takes at most this share of the time."""


@dataclasses.dataclass
class OpenRun:
    """A stream in progress, and the folder that it is saved in."""

    folder: RunFolder
    session: Session
    capture: Capture  # as it is streamed: with adjusted poses, if any
    indices: list[int]  # frames to stream, ascending; a watched run adds those that have become complete
    weights: str  # digest of the parameters
    stream_frame: StreamFrame = dataclasses.field(init=False)  # of the next chunk
    exposures: Exposures = dataclasses.field(default_factory=dict)  # of the views streamed so far
    images: dict[str, str] = dataclasses.field(default_factory=dict)  # digest of the file of each of them
    num_saved: int = 0  # views in the saved state
    next_save: float = dataclasses.field(default_factory=lambda: time.monotonic() + SAVE_SECONDS)  # monotonic clock

    @property
    def num_views(self) -> int:
        """Views streamed so far."""
        return len(self.exposures)

    def take(self, fed: FedChunk) -> None:
        """Adds a chunk that the session has processed."""
        self.exposures |= fed.exposures
        self.images |= _image_digests(self.capture, fed.frames)
        self.stream_frame = fed.stream_frame

    def identity(self) -> dict[str, Any]:
        """The facts, besides the images, that must be equal for the run to be continued."""
        return {
            "config": self.session.model.config.to_dict(),
            "capture": self.capture.name,
            "size": [self.capture.width, self.capture.height],
            "frames": self.indices,
            "poses": self.capture.digest(self.indices),
            "depth": self.capture.brings_depth,
            "weights": self.weights,
        }

    def save(self) -> None:
        """Saves the stream, unless it is saved already.

        Raises:
            StorageError: the folder cannot be written.
        """
        if self.num_views == self.num_saved:
            return
        assert self.session.cache is not None  # views have been streamed
        began = time.monotonic()
        state = {
            "frame": self.stream_frame.to_dict(),
            "done": self.num_views,
            "exposures": exposures_to_json(self.exposures),
            "images": self.images,  # of streamed views alone: a damaged image further on may still be replaced
        }
        save_state(self.folder.state, self.session.cache, self.identity() | state)
        self.num_saved, ended = self.num_views, time.monotonic()
        self.next_save = ended + max(SAVE_SECONDS, (ended - began) / SAVE_SHARE)

    def resume(self, reporter: Reporter) -> None:
        """Continues from the saved state of this run; if it is damaged, from the one before it, with a warning.

        Raises:
            InputError: the folder holds another run.
            StorageError: both states are damaged.
        """
        try:
            cache, header, damage = load_newest_state(self.folder.state)
        except StorageError as error:
            told = f"{error} No earlier state can be read either; --overwrite starts the run anew."
            raise StorageError(told) from error
        wanted = self.identity()
        held = {name: header[name] for name in wanted}
        held, wanted = ({**facts, "config": deciding(facts["config"])} for facts in (held, wanted))
        check_same(self.folder.path, "a run", held, wanted)
        # Read once the frames are known to be the same.
        images = _image_digests(self.capture, map(int, header["images"]))
        check_same(self.folder.path, "a run", {"images": header["images"]}, {"images": images})
        if damage is not None:
            reporter.warn(f"{damage} Continuing from the state saved before it, after {header['done']} views.")
            restore_previous(self.folder.state)
        self.session.cache, self.stream_frame = cache, StreamFrame.from_dict(header["frame"])
        self.exposures, self.images = exposures_from_json(header["exposures"]), header["images"]
        self.num_saved = header["done"]


@contextlib.contextmanager
def open_run(
    model: StreamSplat,
    params: dict,
    capture: Capture,
    indices: Sequence[int],
    out: Path,
    *,
    adjust_poses: bool = False,
    overwrite: bool = False,
    reporter: Reporter,
) -> Iterator[OpenRun]:
    """The run that the folder `out` holds, or a new one; the folder is locked until the end.

    Args:
        model: the model to run.
        params: the model's parameters.
        capture: the capture to stream.
        indices: its frames to stream, ascending.
        out: folder of the run.
        adjust_poses: adjust the poses to the images before the stream, see `capture_to_stream`.
        overwrite: remove the run that `out` holds and start anew.
        reporter: shows progress and warnings.

    Raises:
        InputError: the capture is unusable or lies in `out`, `out` holds another run, or another process writes to it.
        StorageError: `out` cannot be written, or the saved state and the one before it are damaged.
    """
    check_scorable(capture)
    capture.check_output_folder(out)
    folder = RunFolder(out)
    with lock_folder(out):
        if overwrite:
            folder.clear_run()
        capture = capture_to_stream(capture, indices, folder, reporter, adjust_poses=adjust_poses)
        session = Session(model, params, refine=online_refinement(model))
        run = OpenRun(folder, session, capture, list(indices), params_digest(params))
        if folder.has_state():
            run.resume(reporter)
        else:
            run.stream_frame = begin_stream(session, capture, indices)
            folder.metrics.unlink(missing_ok=True)  # of another run whose state was removed
            folder.clear_refinement()
        # Left by a process that was killed after its last save: these chunks may bring other views.
        for path in (*folder.delta_files(), *folder.chunk_record_files()):
            if int(path.stem) > run.num_views:
                path.unlink(missing_ok=True)
        reporter.warn_all(*capture.notes, run.stream_frame.warning)
        yield run


def deciding(config: dict[str, Any]) -> dict[str, Any]:
    """A configuration without what affects no result: its name, and the capacity of a cache that grows."""
    memory = config["memory"]
    return config | {"preset": None, "memory": memory | ({"capacity": None} if memory["overflow"] == "grow" else {})}


@dataclasses.dataclass(frozen=True)
class SavedRun:
    """The saved state of a run, for the commands that come after it."""

    folder: RunFolder
    cache: VoxelCache
    header: dict[str, Any]
    stream_frame: StreamFrame  # the similarity between the capture's frame and the stream's
    exposures: Exposures  # of the streamed frames

    def session(self, params: dict) -> Session:
        """The stream, to be decoded with the parameters that it was streamed with.

        Raises:
            InputError: they are others.
        """
        if self.header["weights"] != params_digest(params):
            fix = "give the run's own with --weights"
            raise InputError(f"{self.folder.path}: was streamed with other weights than these; {fix}.")
        return Session(StreamSplat(StreamConfig.from_dict(self.header["config"])), params, self.cache)

    def open_capture(self, path: str) -> Capture:
        """The capture that was streamed, with the run's adjusted poses.

        Raises:
            InputError: the capture at `path` is unusable, or its frames, poses or images are others.
            StorageError: the run's adjusted poses are damaged.
        """
        capture = open_capture(path, size=tuple(self.header["size"]))
        capture = with_poses_of_run(capture, self.folder) or capture
        capture = dataclasses.replace(capture, streams_depth=self.header["depth"])
        frames, streamed = self.header["frames"], list(map(int, self.header["images"]))
        is_same = max(frames) < len(capture) and capture.digest(frames) == self.header["poses"]
        if not is_same or _image_digests(capture, streamed) != self.header["images"]:
            got, fix = "another", "give that capture"
            raise InputError(f"{path}: wanted the capture of the run in {self.folder.path}, got {got}; {fix}.")
        return capture


def load_run(run_dir: Path, reporter: Reporter) -> SavedRun:
    """The saved state of a run; of the newest two states the one that can be read, with a warning if it is the older.

    Raises:
        InputError: there is no run in the folder.
        StorageError: no state can be read.
    """
    folder = RunFolder(run_dir)
    if not folder.has_state():
        raise InputError(f"{run_dir}: wanted the folder of an `ssplat run`, found no {folder.state.name} in it.")
    cache, header, damage = load_newest_state(folder.state)
    if damage is not None:
        reporter.warn(f"{damage} Taking the state saved before it, after {header['done']} views.")
    stream_frame, exposures = StreamFrame.from_dict(header["frame"]), exposures_from_json(header["exposures"])
    return SavedRun(folder, cache, header, stream_frame, exposures)


def _image_digests(capture: Capture, frames) -> dict[str, str]:
    """Digest of the image file of each frame."""
    return {str(i): capture.files_digest(i) for i in frames}


# -- adjusted poses ----------------------------------------------------------------------------------------------------


POSES_KIND = "adjusted poses 1"


Poses = dict[int, Float64[np.ndarray, "4 4"]]
"""Adjusted poses by frame."""


def save_poses(folder: RunFolder, given: str, poses: Poses) -> None:
    """Writes adjusted poses to the folder of a run; `given` is the digest of these frames with the poses as given."""
    save_arrays(folder.adjusted_poses, {str(i): pose for i, pose in poses.items()}, POSES_KIND, {"capture": given})


def load_poses(folder: RunFolder) -> tuple[str, Poses] | None:
    """The digest and the poses that `save_poses` wrote to `folder`; None if there are none.

    Raises:
        StorageError: it is damaged.
    """
    if not folder.adjusted_poses.exists():
        return None
    arrays, header = load_arrays(folder.adjusted_poses, POSES_KIND)
    return header["capture"], {int(i): pose for i, pose in arrays.items()}


def with_poses_of_run(capture: Capture, folder: RunFolder) -> Capture | None:
    """`capture` with the adjusted poses that `folder` keeps; None if there are none, or those of another capture.

    Raises:
        StorageError: the saved poses are damaged.
    """
    if (saved := load_poses(folder)) is None:
        return None
    given, poses = saved
    if max(poses) >= len(capture) or capture.digest(list(poses)) != given:
        return None
    frames = [dataclasses.replace(f, camtoworld=poses.get(i, f.camtoworld)) for i, f in enumerate(capture.frames)]
    return dataclasses.replace(capture, frames=tuple(frames))


def capture_to_stream(
    capture: Capture, indices: Sequence[int], folder: RunFolder, reporter: Reporter, *, adjust_poses: bool
) -> Capture:
    """The capture with the poses that a run streams: adjusted ones, if they are asked for.

    Args:
        capture: the capture as it was opened.
        indices: frames to stream.
        folder: where a run keeps its adjusted poses; a run that is continued finds them there.
        reporter: shows progress.
        adjust_poses: ask for adjusted ones.

    Raises:
        InputError: the folder holds a run whose poses were not adjusted.
        StorageError: the saved poses are damaged.
    """
    if not adjust_poses:
        if not folder.has_state():  # left by a run that was stopped before its first save
            folder.adjusted_poses.unlink(missing_ok=True)
        return capture
    saved = load_poses(folder)
    if folder.has_state():
        if saved is None:
            got, fix = "one with the given poses", "leave it out, or start anew with --overwrite"
            raise refusal("--adjust-poses", wanted="a run that began with it", got=got, fix=fix)
    elif saved is None or saved[0] != capture.digest(indices):
        found = adjust_and_say(capture, indices, reporter).capture
        save_poses(folder, capture.digest(indices), {i: found.frames[i].camtoworld for i in indices})
    return with_poses_of_run(capture, folder) or capture


def open_capture_of_scene(scene: Path, path: str, size: tuple[int, int] | None, reporter: Reporter) -> Capture:
    """The capture at `path`, with the adjusted poses of the run that `scene`, a file or a folder, belongs to.

    Raises:
        InputError: the capture is unusable.
        StorageError: the saved poses are damaged.
    """
    folder, capture = RunFolder(scene if scene.is_dir() else scene.parent), open_capture(path, size=size)
    adjusted = with_poses_of_run(capture, folder)
    if adjusted is None and folder.adjusted_poses.exists():  # or of this one at another size
        told = f"{folder.adjusted_poses} is of another capture"
        reporter.warn(f"{told}: the cameras have the poses of {capture.name}.")
    return adjusted or capture
