"""Scenes on disk that may change while they are viewed: a scene file, or a run that is still streaming.

A run with `--deltas` writes a file per chunk. The viewer reads these in a process of its own, so that the stream waits
for no browser, and viewers may come and go.
"""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from ssplat_jax.core.errors import InputError, StorageError
from ssplat_jax.core.gaussians import Gaussians, scale_colors
from ssplat_jax.core.pytree import replace
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.scene_files.formats import load_scene
from ssplat_jax.storage.chunk_records import load_delta, load_delta_header
from ssplat_jax.storage.run_folder import RunFolder
from ssplat_jax.streaming.scene_delta import apply_delta


class SceneFile:
    """A scene file, which is read again whenever it is rewritten.

    Args:
        path: the file.
    """

    num_chunks = 1

    def __init__(self, path: Path) -> None:
        self._stamp = None  # of scene and metrics at the last look
        self.path, self.folder = path, RunFolder(path.parent)

    def changed(self) -> Gaussians | None:
        """The scene if it has changed since the last call, else None.

        Raises:
            InputError: there was no scene before and the file is none.
        """
        stamp = scene, metrics = _stamp(self.path), _stamp(self.folder.metrics)
        if self._stamp is not None:
            # A run that ends again removes its metrics, writes its scene, and writes its metrics last.
            is_ending = metrics is None and self._stamp[1] is not None
            if scene is None or stamp == self._stamp or is_ending:
                return None
        is_first, self._stamp = self._stamp is None, stamp
        try:
            return load_scene(self.path)
        except InputError:
            if is_first:
                raise
            return None  # another program may be in the middle of rewriting it: the scene so far stays

    def stream_frame(self) -> StreamFrame | None:
        """The frame of the stream of the run that wrote the file; None if no metrics of a run are beside it."""
        try:
            return StreamFrame.from_dict(json.loads(self.folder.metrics.read_bytes())["stream_frame"])
        except (OSError, ValueError, TypeError, LookupError):  # another file of that name must not prevent viewing
            return None


def _stamp(path: Path) -> tuple[int, int] | None:
    """Time and size of a file, which change when it is written again; None if there is none."""
    try:
        stat = path.stat()
    except OSError:
        return None
    return stat.st_mtime_ns, stat.st_size


class _Sum:
    """The sum of the first deltas of a run."""

    def __init__(self) -> None:
        self.applied: list[tuple[str, int]] = []  # names and time stamps of the deltas
        self.stream_frame: StreamFrame | None = None
        self._sum: Gaussians | None = None  # in the stream frame
        self._exposure = np.ones(3)  # at which the scene is shown: the middle one of the views so far

    def add(self, path: Path, stamp: int) -> None:
        """Adds a delta.

        Raises:
            StorageError: it is damaged or gone.
        """
        delta, header = load_delta(path), load_delta_header(path)
        self._sum = apply_delta(self._sum, delta)
        self.stream_frame, self._exposure = StreamFrame.from_dict(header["frame"]), np.array(header["exposure"])
        self.applied.append((path.name, stamp))

    def scene(self) -> Gaussians:
        """The scene in the capture's frame, relative to its offset; there must be a delta."""
        assert self.stream_frame is not None
        scene = scale_colors(jax.tree.map(jnp.asarray, self._sum), jnp.asarray(self._exposure, jnp.float32))
        gaussians = self.stream_frame.gaussians_to_capture(scene, offset=self.stream_frame.offset)
        return replace(gaussians, offset=self.stream_frame.offset)


class GrowingScene:
    """The sum of the deltas that a run has written so far, and after all of them the refined scene, if there is one.

    Args:
        folder: the folder of the run.
    """

    def __init__(self, folder: RunFolder) -> None:
        self.path, self.folder = folder.path, folder
        self._newest, self._past = _Sum(), _Sum()
        self._refined: SceneFile | None = None

    @property
    def num_chunks(self) -> int:
        """Chunks whose deltas have been added."""
        return len(self._newest.applied)

    def changed(self) -> Gaussians | None:
        """Displayable scene, or None if unchanged since the last call.

        If the run was started anew, the old scene is dropped.

        Raises:
            StorageError: a delta is damaged.
        """
        streamed, refined = self._streamed(), self.folder.refined_scene
        if not refined.is_file():
            self._refined = None
            return streamed
        if self._refined is None:
            self._refined = SceneFile(refined)
        return self._refined.changed()

    def _streamed(self) -> Gaussians | None:
        """The sum of all deltas, or None if unchanged since the last call."""
        try:
            found = [(path.name, path.stat().st_mtime_ns) for path in self.folder.delta_files()]
        except FileNotFoundError:  # the run is being started anew
            return None
        if found == self._newest.applied or not found:
            return None
        if found[: self.num_chunks] != self._newest.applied:
            self._newest = _Sum()
        for name, stamp in found[self.num_chunks :]:
            path = self.folder.deltas / name
            try:
                self._newest.add(path, stamp)
            except StorageError:
                if path.exists():
                    raise
                self._newest = _Sum()  # the run is being started anew
                return None
        return self._newest.scene()

    def at(self, num_chunks: int) -> Gaussians:
        """The scene as it was after so many chunks, at least one and not all.

        Raises:
            StorageError: a delta is damaged or gone.
        """
        wanted = self._newest.applied[:num_chunks]
        if self._past.applied != wanted[: len(self._past.applied)]:  # later than wanted, or of another run
            self._past = _Sum()
        for name, stamp in wanted[len(self._past.applied) :]:
            self._past.add(self.folder.deltas / name, stamp)
        return self._past.scene()

    def stream_frame(self) -> StreamFrame | None:
        """The frame of the stream; None before the first delta."""
        return self._newest.stream_frame


Source = SceneFile | GrowingScene


def open_source(path: Path) -> Source:
    """The source at `path`: a scene file, or the deltas of a run's folder, or else its scene.

    Raises:
        InputError: there is none.
    """
    folder = RunFolder(path)
    file = folder.best_scene if path.is_dir() else path
    if folder.deltas.is_dir() and (folder.delta_files() or not file.is_file()):
        return GrowingScene(folder)
    if not file.is_file():
        raise InputError(
            f"{path}: wanted a scene file, or the folder of an `ssplat run` that has ended or writes --deltas, found"
            " neither; wait for its scene, or check the path."
        )
    return SceneFile(file)
