"""The frames of a capture whose poses are nearest to a given frame's."""

from collections.abc import Sequence

import numpy as np

from ssplat_jax.data.capture import Capture


def nearest_views(capture: Capture, i: int, candidates: Sequence[int]) -> list[int]:
    """The frames `candidates`, nearest to frame `i` first.

    The distance is that of the centers, as a fraction of the candidates' extent, plus the angle between the optical
    axes in radians.
    """
    poses = capture.camtoworlds
    centers = poses[list(candidates), :3, 3]
    extent = max(float(np.linalg.norm(centers.max(axis=0) - centers.min(axis=0))), 1e-12)
    distances = np.linalg.norm(centers - poses[i, :3, 3], axis=1) / extent
    cosines = np.einsum("vi,i->v", poses[list(candidates), :3, 2], poses[i, :3, 2])
    return [candidates[j] for j in np.argsort(distances + np.arccos(np.clip(cosines, -1, 1)), kind="stable")]
