"""`ssplat view`: a scene file, or the folder of a run while it grows, shown in a browser.

A run with `--deltas` writes what every chunk changed; whoever looks reads those files in a process of their own, and
the stream does not wait.
"""

import json
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from ssplat_jax.checkpoint.delta_files import load_delta, load_delta_header
from ssplat_jax.console import Reporter
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.errors import InputError, StorageError
from ssplat_jax.gaussians import Gaussians
from ssplat_jax.scene_files.ply import load_ply
from ssplat_jax.storage.interrupts import Interrupts
from ssplat_jax.streaming.scene_delta import apply_delta
from ssplat_jax.viewer.viser_viewer import LOCAL_HOSTS, StartCamera, Viewer

SCENE_FILE, METRICS_FILE, DELTAS = "scene.ply", "metrics.json", "deltas"  # of a run's folder
INTERVAL = 0.5  # seconds between looks at the files: browsers are sent no more than two scenes a second


class SceneFile:
    """A .ply, read again when it is written again."""

    def __init__(self, path: Path) -> None:
        self._path, self._stamp = path, None

    def changed(self) -> Gaussians | None:
        """The scene, if it is another than at the last call.

        Raises:
            InputError: the file is no scene.
        """
        stat = self._path.stat() if self._path.exists() else None
        stamp = None if stat is None else (stat.st_mtime_ns, stat.st_size)
        if self._stamp is not None and stamp in (None, self._stamp):
            return None
        self._stamp = stamp
        return load_ply(self._path)

    def start_camera(self) -> StartCamera | None:
        """Where to look from at first: where the run beside it began, if one is there."""
        try:
            fields = json.loads((self._path.parent / METRICS_FILE).read_bytes())["stream_frame"]
            return first_camera(StreamFrame.from_dict(fields))
        except (OSError, ValueError, TypeError, LookupError):  # whatever else bears that name is no reason not to look
            return None


class GrowingScene:
    """What a run's deltas add up to so far."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._told: list[tuple[str, int]] = []
        self._scene: Gaussians | None = None
        self._frame: StreamFrame | None = None

    def changed(self) -> Gaussians | None:
        """The scene in the capture's frame, if it is another than at the last call; all of a run that started anew.

        Raises:
            StorageError: a delta is damaged.
        """
        try:
            found = sorted((path.name, path.stat().st_mtime_ns) for path in self._folder.glob("*.npz"))
        except FileNotFoundError:  # the run is being started anew
            return None
        if found == self._told or not found:
            return None
        if found[: len(self._told)] != self._told:
            self._told, self._scene = [], None
        for name, stamp in found[len(self._told) :]:
            path = self._folder / name
            try:
                self._scene = apply_delta(self._scene, load_delta(path))
                self._frame = StreamFrame.from_dict(load_delta_header(path)["frame"])
            except StorageError:
                if path.exists():
                    raise
                self._told, self._scene = [], None  # as above
                return None
            self._told.append((name, stamp))
        assert self._frame is not None
        scene = jax.tree.map(jnp.asarray, self._scene)
        return self._frame.gaussians_to_capture(scene, offset=self._frame.offset)

    def start_camera(self) -> StartCamera | None:
        """Where to look from at first: where the stream began."""
        return None if self._frame is None else first_camera(self._frame)


def view_scene(path: Path, *, host: str, port: int, most: int, reporter: Reporter) -> None:
    """Shows the scene at `path`, a .ply or the folder of a run, and its changes, until Ctrl-C.

    Raises:
        InputError: no scene there, viser is missing, or the address is taken.
        StorageError: a file of the run is damaged.
    """
    source = source_of(path)
    scene = source.changed()
    viewer = Viewer(host=host, port=port, most=most)
    try:
        if host not in LOCAL_HOSTS:
            reporter.warn(f"whoever reaches this machine at {host} can look; there is no password.")
        print(f"{viewer.url} shows {path}; Ctrl-C ends it", flush=True)
        has_camera = False
        with Interrupts() as interrupts:
            while not interrupts.received:
                if scene is not None:
                    camera = source.start_camera() or camera_before(scene)
                    if not has_camera and camera is not None:
                        viewer.look_from(camera)
                        has_camera = True
                    viewer.show(scene)
                time.sleep(INTERVAL)
                scene = source.changed()
    finally:
        viewer.close()


def source_of(path: Path) -> SceneFile | GrowingScene:
    """The deltas of a run's folder, or its scene, or the file.

    Raises:
        InputError: there is none.
    """
    file = path / SCENE_FILE if path.is_dir() else path
    deltas = path / DELTAS
    if deltas.is_dir() and (any(deltas.glob("*.npz")) or not file.is_file()):
        return GrowingScene(deltas)
    if not file.is_file():
        raise InputError(
            f"{path}: wanted a .ply, or the folder of an `ssplat run` that has ended or writes --deltas, found neither;"
            " wait for its scene, or check the path."
        )
    return SceneFile(file)


def first_camera(frame: StreamFrame) -> StartCamera:
    """A stream's first camera, which looks at its middle depth."""
    depth = np.sqrt(frame.near * frame.far) / frame.scale
    position = frame.origin - np.asarray(frame.offset)
    return StartCamera(position, position + depth * frame.rotation[:, 2], up=-frame.rotation[:, 1])


def camera_before(scene: Gaussians) -> StartCamera | None:
    """A camera from which all of a scene is seen, if y points down and z ahead; None of an empty one."""
    means = np.asarray(scene.means, np.float64)[np.asarray(scene.opacities) > 0]
    means = means[np.isfinite(means).all(axis=1)]
    if len(means) == 0:
        return None
    center = np.median(means, axis=0)
    distance = 3 * float(np.median(np.linalg.norm(means - center, axis=1))) or 1.0
    return StartCamera(center - [0.0, 0.0, distance], center, up=np.array([0.0, -1.0, 0.0]))
