"""`Stage`: the scene that all browsers look at, in the units in which they are sent it, and the run that made it.

viser clips what is nearer than 0.01 or farther than 1000. Lengths are therefore divided by `distance`, so that the
first camera looks at a point at distance 1.
"""

import numpy as np
from jaxtyping import Float64

from ssplat_jax.core.errors import StorageError
from ssplat_jax.data.camera_path import camera_path
from ssplat_jax.storage.chunk_records import ChunkRecord, RecordedView, load_chunk_records
from ssplat_jax.storage.run_folder import RunFolder
from ssplat_jax.viewer.scene_sources import SceneFile, Source, ViewedScene
from ssplat_jax.viewer.shown_scene import median_size, visible_splats

PATH_STEPS = 12
"""Cameras of a playback from each streamed camera to the next."""


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

    def views(self, num_chunks: int | None = None) -> list[RecordedView]:
        """The views of the first chunks, or of all, in the order of streaming."""
        return [view for record in self.records[:num_chunks] for view in record.views]

    @property
    def fov(self) -> float | None:
        """Angle of view of the shorter side of the first view, radians; None without records."""
        if not self.records:
            return None
        (width, height), K = self.records[0].size, self.records[0].views[0].K
        return float(2 * np.arctan(min(width / K[0, 0], height / K[1, 1]) / 2))

    def nearest(self, camtoworld: Float64[np.ndarray, "4 4"]) -> RecordedView | None:
        """The view whose camera is nearest, with a turn by a radian counted as a unit of the cameras' spread."""
        views = self.views()
        if not views:
            return None
        poses = np.stack([view.camtoworld for view in views])
        spread = float(np.linalg.norm(np.ptp(poses[:, :3, 3], axis=0))) or 1.0
        distances = np.linalg.norm(poses[:, :3, 3] - camtoworld[:3, 3], axis=1) / spread
        turns = np.arccos(np.clip(poses[:, :3, 2] @ camtoworld[:3, 2], -1.0, 1.0))
        return views[int(np.argmin(distances + turns))]

    def in_order(self) -> list[RecordedView]:
        """The views in the order of the capture."""
        return sorted(self.views(), key=lambda view: view.frame)

    def path(self) -> Float64[np.ndarray, "m 4 4"]:
        """Smooth path through the cameras in the order of the capture."""
        if not (views := self.in_order()):
            return np.zeros((0, 4, 4))
        poses, Ks = np.stack([view.camtoworld for view in views]), np.stack([view.K for view in views])
        return camera_path(poses, Ks, PATH_STEPS)[0]


class Stage:
    """The newest scene of a source, and the earlier ones on request.

    Args:
        source: where scenes come from.
        max_gaussians: most Gaussians sent to a browser.
        over_black: show holes black.
    """

    def __init__(self, source: Source, *, max_gaussians: int, over_black: bool = False) -> None:
        self.source, self.run = source, RecordedRun(source.folder)
        self.over_black, self._max_gaussians = over_black, max_gaussians
        self.version, self.records_version = 0, 0  # numbers of changes so far
        self.unit, self.distance = 1.0, 1.0  # scene units per unit of splats, and per unit of the browser
        self.start: Float64[np.ndarray, "4 4"] | None = None  # the pose at which browsers start, scene units
        self.num_starts = 0  # start poses so far: a run of other poses brings another one, and other units
        self._place: tuple | None = None  # of the stream, when the start pose was set
        self._newest: ViewedScene | None = None
        self._packed: tuple[ViewedScene, dict[str, np.ndarray]] | None = None  # the scene packed last

    def refresh(self) -> bool:
        """Looks for changes of the source; returns whether the scene changed.

        Raises:
            InputError, StorageError: see the source.
        """
        self.records_version += self.run.refresh()
        if (changed := self.source.changed()) is None:
            return False
        self._set_start(changed)
        self._newest, self.version = changed, self.version + 1
        return True

    def _set_start(self, scene: ViewedScene) -> None:
        """Sets start pose and units by the first scene of a stream."""
        frame = self.source.frame()
        # A stream is told by its first camera and its scale; a causal one may widen its depth range.
        place = None if frame is None else (frame.rotation.tolist(), frame.origin.tolist(), frame.scale)
        if self.start is not None and place in (None, self._place):
            return
        pose = np.eye(4)
        if frame is not None:
            pose[:3, :3], pose[:3, 3] = frame.rotation, frame.origin
            distance = np.sqrt(frame.near * frame.far) / frame.scale  # the middle of the depth range
            # A finished run starts in the middle of the capture: around its first camera a scene often ends.
            if isinstance(self.source, SceneFile) and (views := self.run.in_order()):
                pose = views[len(views) // 2].camtoworld.copy()
            pose[:3, 3] -= frame.offset
        else:  # a lone scene file is seen as a whole, y down and z forward
            means = np.asarray(scene.gaussians.means, np.float64)[np.asarray(scene.gaussians.opacities) > 0]
            means = means[np.isfinite(means).all(axis=1)]
            if len(means) == 0:
                return
            center = np.median(means, axis=0)
            distance = 3 * np.median(np.linalg.norm(means - center, axis=1)) or 1.0
            pose[:3, 3] = center - [0.0, 0.0, distance]
        self.start, self._place, self.num_starts = pose, place, self.num_starts + 1
        self.unit, self.distance = median_size(scene.gaussians), float(distance)

    def scene(self, num_chunks: int | None = None) -> ViewedScene | None:
        """The scene after so many chunks, by default the newest; None if there is none yet."""
        source = self.source
        if num_chunks is None or isinstance(source, SceneFile) or num_chunks >= source.num_chunks:
            return self._newest
        try:
            return source.at(num_chunks)
        except StorageError:  # every file was read before: the run is being started anew
            return self._newest

    def splats(self, scene: ViewedScene) -> dict[str, np.ndarray]:
        """A scene as it is sent, in units of `unit`; kept until another one is asked for, since many browsers ask."""
        if self._packed is None or self._packed[0] is not scene:
            self._packed = (scene, visible_splats(scene.gaussians, self.unit, self._max_gaussians))
        return self._packed[1]

    @property
    def offset(self) -> Float64[np.ndarray, "3"]:
        """Offset of the scene's positions, in the capture's frame."""
        return np.zeros(3) if self._newest is None else np.asarray(self._newest.offset)

    def to_browser(self, camtoworld: Float64[np.ndarray, "4 4"]) -> Float64[np.ndarray, "4 4"]:
        """A pose of the capture in the browser's units."""
        pose = camtoworld.copy()
        pose[:3, 3] = (pose[:3, 3] - self.offset) / self.distance
        return pose
