"""The camera from which a browser looks at a scene first."""

import dataclasses

import numpy as np
from jaxtyping import Float64

from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.data.stream_frame import StreamFrame


@dataclasses.dataclass(frozen=True)
class StartCamera:
    """Position and direction of view, in scene units."""

    position: Float64[np.ndarray, "3"]
    look_at: Float64[np.ndarray, "3"]
    up: Float64[np.ndarray, "3"]


def first_camera(frame: StreamFrame) -> StartCamera:
    """The first camera of a stream, looking at the middle of its depth range."""
    depth = np.sqrt(frame.near * frame.far) / frame.scale
    position = frame.origin - np.asarray(frame.offset)
    return StartCamera(position, position + depth * frame.rotation[:, 2], up=-frame.rotation[:, 1])


def turned_to(start: StartCamera, camtoworld: Float64[np.ndarray, "4 4"]) -> StartCamera:
    """A camera at a pose (OpenCV axes, scene units) that looks as far as `start` does."""
    distance = np.linalg.norm(start.look_at - start.position)
    position = camtoworld[:3, 3]
    return StartCamera(position, position + distance * camtoworld[:3, 2], up=-camtoworld[:3, 1])


def camera_before(scene: Gaussians) -> StartCamera | None:
    """A camera that sees a whole scene in which y points down and z forward; None if the scene is empty."""
    means = np.asarray(scene.means, np.float64)[np.asarray(scene.opacities) > 0]
    means = means[np.isfinite(means).all(axis=1)]
    if len(means) == 0:
        return None
    center = np.median(means, axis=0)
    distance = 3 * float(np.median(np.linalg.norm(means - center, axis=1))) or 1.0
    return StartCamera(center - [0.0, 0.0, distance], center, up=np.array([0.0, -1.0, 0.0]))
