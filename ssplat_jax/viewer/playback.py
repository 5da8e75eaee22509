"""Playback: camera motions in a browser, as functions of time."""

import dataclasses

import numpy as np
from jaxtyping import Float64

from ssplat_jax.data.camera_path import look_at

ORBIT_SECONDS = 24.0
"""Time of a turn."""

POSES_PER_SECOND = 24.0
"""Speed along a path."""


@dataclasses.dataclass(frozen=True, eq=False)
class Orbit:
    """A circle about an axis through a point, always looking at it."""

    position: Float64[np.ndarray, "3"]  # at the start
    target: Float64[np.ndarray, "3"]
    up: Float64[np.ndarray, "3"]  # direction of the axis, and upward in the image

    def pose(self, seconds: float) -> Float64[np.ndarray, "4 4"]:
        """The camera-to-world pose after some time; turns repeat."""
        axis = self.up / np.linalg.norm(self.up)
        angle = 2 * np.pi * seconds / ORBIT_SECONDS
        arm = self.position - self.target
        along = (arm @ axis) * axis
        turned = along + np.cos(angle) * (arm - along) + np.sin(angle) * np.cross(axis, arm)
        return look_at(self.target + turned, self.target, axis)


@dataclasses.dataclass(frozen=True, eq=False)
class PathPlayback:
    """Poses one after another; after the last, the first again."""

    poses: Float64[np.ndarray, "m 4 4"]

    def pose(self, seconds: float) -> Float64[np.ndarray, "4 4"]:
        """The pose after some time."""
        return self.poses[int(seconds * POSES_PER_SECOND) % len(self.poses)]
