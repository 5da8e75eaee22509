"""The chunk records of a run that is viewed: its cameras, their pictures, and its figures."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from ssplat_jax.data.camera_path import camera_path
from ssplat_jax.storage.chunk_records import ChunkRecord, RecordedView, load_chunk_records
from ssplat_jax.storage.run_folder import RunFolder

PATH_STEPS = 12
"""Cameras of a playback from each streamed camera to the next."""


@dataclasses.dataclass
class RecordedRun:
    """The records of a run so far. Without records, as of a lone scene file, all of it is empty."""

    folder: RunFolder
    records: list[ChunkRecord] = dataclasses.field(default_factory=list)
    _stamps: list[tuple[str, int]] = dataclasses.field(default_factory=list)

    def refresh(self) -> bool:
        """Reads the records that are new; returns whether there is a change."""
        try:
            paths = self.folder.chunk_record_files()
            stamps = [(path.name, path.stat().st_mtime_ns) for path in paths]
        except FileNotFoundError:  # the run is being started anew
            return False
        if stamps == self._stamps:
            return False
        if stamps[: len(self._stamps)] != self._stamps:
            self.records, self._stamps = [], []
        new = load_chunk_records(paths[len(self.records) :])
        self.records, self._stamps = [*self.records, *new], stamps[: len(self.records) + len(new)]
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
        centers = poses[:, :3, 3]
        spread = float(np.linalg.norm(np.ptp(centers, axis=0))) or 1.0
        distances = np.linalg.norm(centers - camtoworld[:3, 3], axis=1) / spread
        turns = np.arccos(np.clip(poses[:, :3, 2] @ camtoworld[:3, 2], -1.0, 1.0))
        return views[int(np.argmin(distances + turns))]

    def middle(self) -> RecordedView | None:
        """The view in the middle of the capture's order; None without records."""
        views = self._in_order()
        return views[len(views) // 2] if views else None

    def path(self) -> Float64[np.ndarray, "m 4 4"]:
        """Smooth path through the cameras in the order of the capture."""
        views = self._in_order()
        if not views:
            return np.zeros((0, 4, 4))
        poses, Ks = np.stack([view.camtoworld for view in views]), np.stack([view.K for view in views])
        return camera_path(poses, Ks, PATH_STEPS)[0]

    def _in_order(self) -> list[RecordedView]:
        return sorted(self.views(), key=lambda view: view.frame)


def figures(records: Sequence[ChunkRecord]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Figures that grow with a run, by title: views streamed, and the value after so many."""
    views = np.array([record.num_views for record in records], np.float64)
    scored = [record for record in records if record.held_back_psnr is not None]
    return {
        "Time of a chunk, s": (views, np.array([record.seconds for record in records])),
        "Cache in use, %": (views, np.array([100 * record.occupancy for record in records])),
        "PSNR of held-back views, dB": (
            np.array([record.num_views for record in scored], np.float64),
            np.array([record.held_back_psnr for record in scored], np.float64),
        ),
    }
