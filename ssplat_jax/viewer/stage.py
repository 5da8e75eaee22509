"""`Stage`: the scene that all browsers look at, in the units in which they are sent it.

viser clips what is nearer than 0.01 or farther than 1000. Lengths are therefore divided by `distance`, so that the
first camera looks at a point at distance 1.
"""

import numpy as np
from jaxtyping import Float64

from ssplat_jax.core.errors import StorageError
from ssplat_jax.viewer.recorded_run import RecordedRun
from ssplat_jax.viewer.scene_sources import Source
from ssplat_jax.viewer.splats import Splats, median_size, visible_splats
from ssplat_jax.viewer.start_camera import StartCamera, camera_before
from ssplat_jax.viewer.viewed_scene import ViewedScene


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
        self.start: StartCamera | None = None
        self.num_starts = 0  # start cameras so far: a run of other poses brings another one, and other units
        self._place: tuple | None = None  # of the stream, when the start camera was set
        self._newest: ViewedScene | None = None
        self._packed: tuple[ViewedScene, Splats] | None = None  # of the scene packed last

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
        """Sets start camera and units by the first scene of a stream.

        A stream is told by its first camera and its scale; a causal one may widen its depth range.
        """
        frame = self.source.frame()
        place = None if frame is None else (frame.rotation.tolist(), frame.origin.tolist(), frame.scale)
        if self.start is not None and place in (None, self._place):
            return
        if (start := self.source.start_camera() or camera_before(scene.gaussians)) is not None:
            self.start, self._place, self.num_starts = start, place, self.num_starts + 1
            self.unit = median_size(scene.gaussians)
            self.distance = float(np.linalg.norm(start.look_at - start.position)) or 1.0

    @property
    def num_chunks(self) -> int:
        """Chunks whose scenes can be shown."""
        return self.source.num_chunks

    def scene(self, num_chunks: int | None = None) -> ViewedScene | None:
        """The scene after so many chunks, by default the newest; None if there is none yet."""
        if num_chunks is None or num_chunks >= self.num_chunks:
            return self._newest
        try:
            return self.source.at(num_chunks)
        except StorageError:  # every file was read before: the run is being started anew
            return self._newest

    def splats(self, scene: ViewedScene) -> Splats:
        """A scene as it is sent, in units of `unit`; kept until another one is asked for, since many browsers ask."""
        if self._packed is None or self._packed[0] is not scene:
            self._packed = (scene, visible_splats(scene.gaussians, self.unit, self._max_gaussians))
        return self._packed[1]

    def to_browser(self, camtoworld: Float64[np.ndarray, "4 4"]) -> Float64[np.ndarray, "4 4"]:
        """A pose of the capture in the browser's units."""
        offset = np.zeros(3) if self._newest is None else np.asarray(self._newest.offset)
        pose = camtoworld.copy()
        pose[:3, 3] = (pose[:3, 3] - offset) / self.distance
        return pose

    def to_scene(self, pose: Float64[np.ndarray, "4 4"]) -> Float64[np.ndarray, "4 4"]:
        """A pose of the browser in the units of the scene, relative to its offset."""
        scaled = pose.copy()
        scaled[:3, 3] *= self.distance
        return scaled

    def to_capture(self, pose: Float64[np.ndarray, "4 4"]) -> Float64[np.ndarray, "4 4"]:
        """A pose of the browser in the capture's frame: the inverse of `to_browser`."""
        scaled = self.to_scene(pose)
        scaled[:3, 3] += np.zeros(3) if self._newest is None else np.asarray(self._newest.offset)
        return scaled
