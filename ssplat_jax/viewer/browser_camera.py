"""`BrowserCamera`: the camera of a browser's window, and poses as viser takes them."""

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from ssplat_jax.data.posed_image import pose_from_quat


@dataclasses.dataclass(frozen=True, eq=False)
class BrowserCamera:
    """Pose and field of view of a window."""

    camtoworld: Float64[np.ndarray, "4 4"]  # OpenCV axes
    fov: float  # vertical, radians
    aspect: float  # width over height

    def K(self, size: tuple[int, int]) -> Float64[np.ndarray, "3 3"]:
        """Intrinsics of a picture of any size (width, height), pixels, that is stretched over the window."""
        width, height = size
        fy = height / 2 / np.tan(self.fov / 2)
        fx = fy * width / height / self.aspect
        return np.array([[fx, 0.0, width / 2], [0.0, fy, height / 2], [0.0, 0.0, 1.0]])

    def is_same(self, other: "BrowserCamera") -> bool:
        """True if both show the same."""
        same_window = (self.fov, self.aspect) == (other.fov, other.aspect)
        return same_window and np.array_equal(self.camtoworld, other.camtoworld)


def camera_of(client: Any) -> BrowserCamera:
    """The camera of a client of viser, in the browser's units."""
    camera = client.camera
    pose = pose_from_quat(camera.wxyz, camera.position, "browser")
    return BrowserCamera(pose, float(camera.fov), float(camera.image_width) / max(float(camera.image_height), 1.0))


def set_camera(client: Any, pose: Float64[np.ndarray, "4 4"]) -> None:
    """Moves the camera of a client of viser to a pose, in the browser's units."""
    with client.atomic():
        client.camera.position = pose[:3, 3]
        client.camera.wxyz = wxyz_of(pose)


def wxyz_of(pose: Float64[np.ndarray, "4 4"]) -> Float64[np.ndarray, "4"]:
    """The quaternion of a pose."""
    return Rotation.from_matrix(pose[:3, :3]).as_quat()[[3, 0, 1, 2]]
