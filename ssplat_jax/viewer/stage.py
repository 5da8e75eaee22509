"""Scenes on disk that may change while they are viewed, and `Stage`, the scene that all browsers look at.

Browsers are sent splats, or pictures by our rasterizer. viser clips what is nearer than 0.01 or farther than 1000.
Lengths are therefore divided by `distance`, so that the first camera looks at a point at distance 1. It stores
covariances as 16-bit floats, in which a Gaussian of 1e-4 units vanishes: Gaussians are sent in units of the scene's
median Gaussian, colored by the constant band of their spherical harmonics.
"""

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64, UInt8

from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.errors import InputError, StorageError
from ssplat_jax.core.false_colors import color_depth, eight_bits, scale_ends
from ssplat_jax.core.gaussians import SH_C0, Gaussians, mean_color, scale_colors
from ssplat_jax.core.kept_programs import Kept
from ssplat_jax.core.pytree import replace
from ssplat_jax.core.rotations import quats_to_matrices
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.rasterizer import effects_for, fill_holes, render
from ssplat_jax.rasterizer.effects import FILTERS
from ssplat_jax.scene_files.formats import load_scene
from ssplat_jax.scene_files.splat_rows import MIN_OPACITY
from ssplat_jax.storage.chunk_records import ChunkRecord, RecordedView, load_chunk_records, load_delta
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
        return frame.gaussians_to_capture(scene)

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
        wanted = "a scene file, or the folder of an `ssplat run` that has ended or writes --deltas"
        raise InputError(f"{path}: wanted {wanted}, found neither; wait for its scene, or check the path.")
    return SceneFile(file)


# -- stage -------------------------------------------------------------------------------------------------------------


MAX_SIGMA = 250.0  # largest standard deviation that is sent: the square of 256 overflows a 16-bit float
KINDS = ("color", "depth")  # kinds of picture

DRAFT, FINE = (320, 240), (960, 640)
"""Sizes (width, height) of pictures while the camera moves, and when it rests. They are fixed, so that few programs are
compiled: pixels are not square, and the browser stretches a picture over its window."""


class RecordedRun:
    """The chunk records of a run so far. Without records, as of a lone scene file, all of it is empty."""

    def __init__(self, folder: RunFolder) -> None:
        self._folder, self._stamps = folder, []
        self.records: list[ChunkRecord] = []

    def refresh(self) -> bool:
        """Reads the records that are new; returns whether there is a change."""
        try:
            paths = self._folder.chunk_record_files()
            stamps = [(path.name, path.stat().st_mtime_ns) for path in paths]
        except FileNotFoundError:  # the run is being started anew
            return False
        if stamps == self._stamps:
            return False
        if stamps[: len(self._stamps)] != self._stamps:
            self.records = []
        self.records = [*self.records, *load_chunk_records(paths[len(self.records) :])]
        self._stamps = stamps[: len(self.records)]
        return True

    def views(self) -> list[RecordedView]:
        """The views in the order of streaming."""
        return [view for record in self.records for view in record.views]

    @property
    def fov(self) -> float | None:
        """Angle of view of the shorter side of the first view, radians; None without records."""
        if not self.records:
            return None
        (width, height), K = self.records[0].size, self.records[0].views[0].K
        return float(2 * np.arctan(min(width / K[0, 0], height / K[1, 1]) / 2))


class Stage:
    """The newest scene of a source, and where browsers start to look at it.

    Args:
        source: where scenes come from.
        max_gaussians: most Gaussians sent to a browser.
    """

    def __init__(self, source: Source, *, max_gaussians: int) -> None:
        self.source, self.run, self._max_gaussians = source, RecordedRun(source.folder), max_gaussians
        self.version, self.records_version = 0, 0  # numbers of changes so far
        self.unit, self.distance = 1.0, 1.0  # scene units per unit of splats, and per unit of the browser
        self.start: Float64[np.ndarray, "4 4"] | None = None  # the pose at which browsers start, scene units
        self.num_starts = 0  # start poses so far: a run of other poses brings another one, and other units
        self._place: tuple | None = None  # of the stream, when the start pose was set
        self.scene: Gaussians | None = None  # None if there is none yet
        self._packed: tuple[Gaussians, dict[str, np.ndarray]] | None = None  # the scene packed last

    def refresh(self) -> bool:
        """Looks for changes of the source; returns whether the scene changed.

        Raises:
            InputError, StorageError: see the source.
        """
        self.records_version += self.run.refresh()
        if (changed := self.source.changed()) is None:
            return False
        self._set_start(changed)
        self.scene, self.version = changed, self.version + 1
        return True

    def _set_start(self, scene: Gaussians) -> None:
        """Sets start pose and units by the first scene of a stream."""
        frame = self.source.stream_frame()
        # A stream is told by its first camera and its scale; a causal one may widen its depth range.
        place = None if frame is None else (frame.rotation.tolist(), frame.origin.tolist(), frame.scale)
        if self.start is not None and place in (None, self._place):
            return
        pose = np.eye(4)
        if frame is not None:
            pose[:3, :3], pose[:3, 3] = frame.rotation, frame.origin
            distance = np.sqrt(frame.near * frame.far) / frame.scale  # the middle of the depth range
            # A finished run starts in the middle of the capture: around its first camera a scene often ends.
            if isinstance(self.source, SceneFile) and (views := self.run.views()):
                pose = sorted(views, key=lambda view: view.frame)[len(views) // 2].camtoworld.copy()
            pose[:3, 3] -= frame.offset
        else:  # a lone scene file is seen as a whole, y down and z forward
            means = np.asarray(scene.means, np.float64)[np.asarray(scene.opacities) > 0]
            means = means[np.isfinite(means).all(axis=1)]
            if len(means) == 0:
                return
            center = np.median(means, axis=0)
            distance = 3 * np.median(np.linalg.norm(means - center, axis=1)) or 1.0
            pose[:3, 3] = center - [0.0, 0.0, distance]
        self.start, self._place, self.num_starts = pose, place, self.num_starts + 1
        self.unit, self.distance = median_size(scene), float(distance)

    def splats(self, scene: Gaussians) -> dict[str, np.ndarray]:
        """A scene as it is sent, in units of `unit`; kept until another one is asked for, since many browsers ask."""
        if self._packed is None or self._packed[0] is not scene:
            self._packed = (scene, visible_splats(scene, self.unit, self._max_gaussians))
        return self._packed[1]

    def to_browser(self, camtoworld: Float64[np.ndarray, "4 4"]) -> Float64[np.ndarray, "4 4"]:
        """A pose of the capture in the browser's units."""
        pose, offset = camtoworld.copy(), (0.0, 0.0, 0.0) if self.scene is None else self.scene.offset
        pose[:3, 3] = (pose[:3, 3] - offset) / self.distance
        return pose


_jitted_fill_holes = Kept(fill_holes)


def median_size(gaussians: Gaussians) -> float:
    """Median of the largest standard deviations of the visible Gaussians; 1 if there are none."""
    scales = np.asarray(gaussians.scales, np.float64).max(axis=1, initial=0.0)[_is_visible(gaussians)]
    size = float(np.median(scales)) if len(scales) else 0.0
    return size if size > 0 else 1.0


def visible_splats(gaussians: Gaussians, unit: float, max_gaussians: int) -> dict[str, np.ndarray]:
    """The visible Gaussians as arguments of viser, in units of `unit`.

    If there are more than `max_gaussians`, an evenly spaced selection is taken, the same one each time. Its Gaussians
    are enlarged until they cover the area that all of them did; otherwise surfaces would show holes.

    Limits:
        Standard deviations are cut at 250 units. Rows with a non-finite entry or an opacity below 1/255 are dropped.
    """
    rows, growth = np.flatnonzero(_is_visible(gaussians)), 1.0
    if len(rows) > max_gaussians:
        growth = np.sqrt(len(rows) / max_gaussians)
        rows = rows[np.linspace(0, len(rows) - 1, max_gaussians).round().astype(int)]
    fields = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh[:, 0])
    means, quats, scales, opacities, dc = (np.asarray(x)[rows] for x in fields)
    sigmas = np.clip(growth * scales / unit, 0.0, MAX_SIGMA)
    axes = np.asarray(quats_to_matrices(jnp.asarray(quats))) * sigmas[:, None, :]
    splats = {
        "centers": means / unit,
        "covariances": np.einsum("nij,nkj->nik", axes, axes),
        "rgbs": np.clip(0.5 + SH_C0 * dc, 0.0, 1.0),
        "opacities": opacities[:, None],
    }
    return {name: x.astype(np.float32) for name, x in splats.items()}


def _is_visible(gaussians: Gaussians) -> np.ndarray:
    """Mask of the rows that can be drawn and seen."""
    fields = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.sh[:, 0])
    finite = np.all([np.isfinite(np.asarray(x)).all(axis=1) for x in fields], axis=0)
    return finite & (np.asarray(gaussians.opacities) >= MIN_OPACITY)


def draw(
    scene: Gaussians,
    kind: str,
    camtoworld: Float64[np.ndarray, "4 4"],
    K: Float64[np.ndarray, "3 3"],
    size: tuple[int, int],
) -> UInt8[np.ndarray, "h w 3"]:
    """Draws a scene, with holes in the colors around them; depth from light to dark over the depths of the picture.

    Args:
        scene: the scene.
        kind: one of `KINDS`.
        camtoworld: the camera, in the units of the scene.
        K: its intrinsics, pixels.
        size: (width, height) of the picture.
    """
    viewmat = jnp.asarray(np.linalg.inv(camtoworld), jnp.float32)
    view = Camera(viewmats=viewmat, Ks=jnp.asarray(K, jnp.float32), width=size[0], height=size[1])
    scene = replace(scene, offset=(0.0, 0.0, 0.0))  # the camera is relative to it already
    effects = effects_for(scene, view).replace(antialias=FILTERS.get(scene.render_mode, "classic"))
    out = render(scene, view, effects=effects)
    if kind == "depth":
        depth = np.asarray(out.depth)
        return eight_bits(color_depth(depth, *scale_ends(depth[depth > 0])))
    return eight_bits(np.asarray(_jitted_fill_holes(out.color, out.alpha, mean_color(scene))))
