"""Scenes on disk that may change while they are viewed: a scene file, or a run that is still streaming.

A run with `--deltas` writes a file per chunk. The viewer reads these in a process of its own, so that the stream waits
for no browser, and viewers may come and go.
"""

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from ssplat_jax.core.errors import InputError, StorageError
from ssplat_jax.core.gaussians import Gaussians, scale_colors
from ssplat_jax.core.pytree import replace
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.scene_files.formats import load_scene
from ssplat_jax.storage.chunk_records import load_delta
from ssplat_jax.storage.run_folder import RunFolder
from ssplat_jax.streaming.scene_delta import apply_delta


class SceneFile:
    """A scene file, which is read again whenever it is rewritten.

    Args:
        path: the file.
    """

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


class GrowingScene:
    """The sum of the deltas that a run has written so far, and after all of them the refined scene, if there is one.

    Args:
        folder: the folder of the run.
    """

    def __init__(self, folder: RunFolder) -> None:
        self.path, self.folder = folder.path, folder
        self._refined: SceneFile | None = None
        self._forget()

    def _forget(self) -> None:
        """Starts with an empty sum."""
        self._applied: list[tuple[str, int]] = []  # names and time stamps of the deltas
        self._sum: Gaussians | None = None  # in the stream frame
        self._header: dict[str, Any] | None = None  # of the last delta

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
        """The sum of all deltas, in the capture's frame, or None if unchanged since the last call."""
        try:
            found = [(path.name, path.stat().st_mtime_ns) for path in self.folder.delta_files()]
        except FileNotFoundError:  # the run is being started anew
            return None
        if found == self._applied or not found:
            return None
        if found[: len(self._applied)] != self._applied:
            self._forget()
        for name, stamp in found[len(self._applied) :]:
            path = self.folder.deltas / name
            try:
                delta, self._header = load_delta(path)
            except StorageError:
                if path.exists():
                    raise
                self._forget()  # the run is being started anew
                return None
            self._sum = apply_delta(self._sum, delta)
            self._applied.append((name, stamp))
        frame = self.stream_frame()
        assert frame is not None and self._header is not None
        # At the middle exposure of the views so far.
        exposure = jnp.asarray(self._header["exposure"], jnp.float32)
        scene = scale_colors(jax.tree.map(jnp.asarray, self._sum), exposure)
        return replace(frame.gaussians_to_capture(scene, offset=frame.offset), offset=frame.offset)

    def stream_frame(self) -> StreamFrame | None:
        """The frame of the stream; None before the first delta."""
        return None if self._header is None else StreamFrame.from_dict(self._header["frame"])


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
