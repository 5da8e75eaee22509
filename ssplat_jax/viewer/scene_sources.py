"""Scenes on disk that may change while they are viewed: a scene file, or a run that is still streaming."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from ssplat_jax.checkpoint.delta_files import load_delta, load_delta_header
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.errors import InputError, StorageError
from ssplat_jax.gaussians import Gaussians, scale_colors
from ssplat_jax.scene_files.formats import load_scene
from ssplat_jax.storage.run_folder import RunFolder
from ssplat_jax.streaming.scene_delta import apply_delta
from ssplat_jax.streaming.scene_exposure import at_first_exposure, scene_exposure
from ssplat_jax.viewer.start_camera import StartCamera, first_camera


class SceneFile:
    """A scene file, which is read again whenever it is rewritten.

    Args:
        path: the file.
        one_exposure: give a run's scene at the exposure of its first views.
    """

    def __init__(self, path: Path, *, one_exposure: bool = False) -> None:
        self._path, self._stamp, self._one_exposure = path, None, one_exposure

    def changed(self) -> Gaussians | None:
        """The scene if it has changed since the last call, else None.

        Raises:
            InputError: the file is not a scene, or its exposure is wanted and unknown.
        """
        stat = self._path.stat() if self._path.exists() else None
        stamp = None if stat is None else (stat.st_mtime_ns, stat.st_size)
        if self._stamp is not None and stamp in (None, self._stamp):
            return None
        self._stamp = stamp
        scene = load_scene(self._path)
        return at_first_exposure(scene, scene_exposure(self._path)) if self._one_exposure else scene

    def start_camera(self) -> StartCamera | None:
        """The first camera of the run that wrote the file; None if no metrics of a run are beside it."""
        try:
            fields = json.loads(RunFolder(self._path.parent).metrics.read_bytes())["stream_frame"]
            return first_camera(StreamFrame.from_dict(fields))
        except (OSError, ValueError, TypeError, LookupError):  # another file of that name must not prevent viewing
            return None


class GrowingScene:
    """The sum of the deltas that a run has written so far.

    Args:
        folder: the folder of the run.
        one_exposure: give the scene at the exposure of its first views instead of the middle one of those so far.
    """

    def __init__(self, folder: RunFolder, *, one_exposure: bool = False) -> None:
        self._folder, self._one_exposure = folder, one_exposure
        self._applied: list[tuple[str, int]] = []  # names and time stamps of the deltas in `_scene`
        self._scene: Gaussians | None = None
        self._frame: StreamFrame | None = None
        self._exposure = np.ones(3)  # at which the scene is shown: the middle one of the views so far

    def changed(self) -> Gaussians | None:
        """The scene as a person gets it so far, in the capture's frame, if it changed since the last call, else None.

        If the run was started anew, the old scene is dropped.

        Raises:
            StorageError: a delta is damaged.
        """
        try:
            found = [(path.name, path.stat().st_mtime_ns) for path in self._folder.delta_files()]
        except FileNotFoundError:  # the run is being started anew
            return None
        if found == self._applied or not found:
            return None
        if found[: len(self._applied)] != self._applied:
            self._applied, self._scene = [], None
        for name, stamp in found[len(self._applied) :]:
            path = self._folder.deltas / name
            try:
                self._scene = apply_delta(self._scene, load_delta(path))
                header = load_delta_header(path)
                self._frame = StreamFrame.from_dict(header["frame"])
                self._exposure = np.array(header.get("exposure", [1.0, 1.0, 1.0]))  # earlier versions wrote none
            except StorageError:
                if path.exists():
                    raise
                self._applied, self._scene = [], None  # the run is being started anew
                return None
            self._applied.append((name, stamp))
        assert self._frame is not None
        factors = jnp.asarray(np.ones(3) if self._one_exposure else self._exposure, jnp.float32)
        scene = scale_colors(jax.tree.map(jnp.asarray, self._scene), factors)
        return self._frame.gaussians_to_capture(scene, offset=self._frame.offset)

    def start_camera(self) -> StartCamera | None:
        """The first camera of the stream; None before the first delta."""
        return None if self._frame is None else first_camera(self._frame)


def open_source(path: Path, *, one_exposure: bool = False) -> SceneFile | GrowingScene:
    """The source at `path`: a scene file, or the deltas of a run's folder, or else its scene.

    With `one_exposure`, scenes are at the exposure of the first views of their run.

    Raises:
        InputError: there is none.
    """
    folder = RunFolder(path)
    file = folder.scene if path.is_dir() else path
    if folder.deltas.is_dir() and (folder.has_deltas() or not file.is_file()):
        return GrowingScene(folder, one_exposure=one_exposure)
    if not file.is_file():
        raise InputError(
            f"{path}: wanted a .ply, or the folder of an `ssplat run` that has ended or writes --deltas, found neither;"
            " wait for its scene, or check the path."
        )
    return SceneFile(file, one_exposure=one_exposure)
