"""`Frame`, one posed image of a capture; the checks of poses and intrinsics; and the conventions of poses in files.

Readers know which convention their format prescribes. Files that follow another one are read with the options `axes`
and `poses` at the end of the capture's path, such as `scene?axes=opencv&poses=world-to-camera`.
"""

import dataclasses
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float64

from ssplat_jax.core.errors import echo, refusal
from ssplat_jax.data.images import Lens, Matrix

Pose = Float64[np.ndarray, "4 4"]

ROTATION_TOLERANCE = 5e-3  # largest |R^T R - I| that rounding to three decimals explains; larger ones are refused
ROTATION_ROUNDING = 1e-5  # deviations above this are reported to the user
MILLIMETER = 1e-3  # meters
OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])  # flips the y and z axes of a camera
MAX_COORDINATE = 1e12  # capture units; squares of larger ones leave float32 on the way, and no unit explains them
MAX_FOCAL_SIDES = 1000.0  # of the image; a longer focal length sees less than 0.06 degrees
MIN_FOCAL_PX = 3.0  # smaller focal lengths are taken to be in units of the image size instead of pixels


@dataclasses.dataclass(frozen=True, eq=False)
class Frame:
    """One posed image as stored, before it is resized."""

    name: str  # in the capture's files
    camtoworld: Pose  # OpenCV axes, capture frame
    K: Matrix  # pixels of the stored image; the center of the first pixel is (0.5, 0.5)
    width: int
    height: int
    path: Path | None = None  # None: the image is in memory
    depth_path: Path | None = None  # 16-bit PNG
    depth_unit: float = MILLIMETER  # capture units per step of the depth image
    pose_deviation: float = 0.0  # |R^T R - I| before projection
    shrink: float = 1.0  # size of the stored image over the size that the intrinsics were given for
    lens: Lens | None = None  # distortion of the stored image, removed when the image is delivered
    distortion_px: float = 0.0  # largest displacement by distortion, whether it is ignored or removed
    mask_path: Path | None = None  # an image, dark where pixels are masked out
    is_masked: bool = False  # whether pixels may be unseen: by a mask, transparent, or outside of a distorted image

    @property
    def center(self) -> Float64[np.ndarray, "3"]:
        """Camera center in the capture frame."""
        return self.camtoworld[:3, 3]


def check_camtoworld(matrix: object, where: str) -> tuple[Pose, float]:
    """Checks an untrusted camera-to-world matrix, 4x4 or 3x4, and replaces its rotation by the nearest one.

    Returns:
        The rigid transform, and the deviation |R^T R - I| of the given rotation.

    Raises:
        InputError: the matrix is not of numbers or of another shape, |R^T R - I| is above `ROTATION_TOLERANCE`, or
            the rotation is a reflection; the message starts with `where`.
    """
    try:
        pose = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        pose = np.zeros(0)
    if pose.shape == (3, 4):
        pose = np.vstack([pose, [0.0, 0.0, 0.0, 1.0]])
    if pose.shape != (4, 4):
        got = f"shape {pose.shape}" if pose.ndim and pose.size else echo(matrix)
        raise refusal(where, wanted="a 4x4 matrix of numbers", got=got, fix="write four rows of four numbers")
    _check_numbers(pose, pose[:3, 3], where)
    if not np.allclose(pose[3], [0.0, 0.0, 0.0, 1.0], rtol=0, atol=1e-6):
        transposed = np.array_equal(pose[:, 3], [0.0, 0.0, 0.0, 1.0])
        fix = "transpose the matrix" if transposed else "give a rigid camera-to-world transform"
        raise refusal(where, wanted="a last row of 0 0 0 1", got=echo(pose[3].tolist()), fix=fix)
    rotation = pose[:3, :3]
    # Huge entries overflow in the product: an infinite deviation is refused like any other.
    with np.errstate(over="ignore", invalid="ignore"):
        deviation = float(np.nan_to_num(np.abs(rotation.T @ rotation - np.eye(3)).max(), nan=np.inf))
    if deviation > ROTATION_TOLERANCE:
        got = f"R^T R that differs from the identity by {deviation:.2g}"
        raise refusal(where, wanted="a rotation (no scale, no shear)", got=got, fix="divide the scale out of it")
    if np.linalg.det(rotation) < 0:
        fix = "flip one axis of the camera or undo the mirroring of the world"
        raise refusal(where, wanted="a rotation with determinant 1", got="determinant -1 (a reflection)", fix=fix)
    u, _, vt = np.linalg.svd(rotation)
    pose[:3, :3], pose[3] = u @ vt, [0.0, 0.0, 0.0, 1.0]
    return pose, deviation


def _check_numbers(values: np.ndarray, translation: Float64[np.ndarray, "3"], where: str) -> None:
    """Refuses numbers that are not finite, and a camera that is absurdly far away: its reconstruction diverged."""
    if not np.isfinite(values).all():
        raise refusal(where, wanted="finite numbers", got="NaN or infinity", fix="drop the frame (tracking was lost)")
    farthest = np.abs(translation).max()
    if farthest > MAX_COORDINATE:
        fix = "drop the frame or choose a larger unit"
        raise refusal(where, wanted=f"coordinates up to {MAX_COORDINATE:.0e}", got=f"{farthest:.2g}", fix=fix)


def pose_from_quat(wxyz: object, translation: object, where: str) -> Pose:
    """The rigid transform of an untrusted quaternion, which is normalized, and a translation.

    Raises:
        InputError: a value is not finite, a coordinate is too large, or the quaternion is shorter than 1e-6.
    """
    quat, translation = np.asarray(wxyz, np.float64), np.asarray(translation, np.float64)
    _check_numbers(np.concatenate([quat, translation]), translation, where)
    length = math.hypot(*quat)  # does not overflow before the length does
    if not 1e-6 <= length < math.inf:
        got = f"a quaternion of length {length:.2g}"
        raise refusal(where, wanted="a rotation", got=got, fix="drop the frame or write a unit quaternion")
    w, x, y, z = quat / length
    pose = np.eye(4)
    pose[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    pose[:3, 3] = translation
    return pose


def invert_pose(pose: Pose) -> Pose:
    """The inverse of a rigid transform."""
    back = np.eye(4)
    back[:3, :3] = pose[:3, :3].T
    back[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return back


def check_intrinsics(*, fx: float, fy: float, cx: float, cy: float, width: int, height: int, where: str) -> Matrix:
    """The intrinsics matrix of checked values in pixels; the center of the first pixel is (0.5, 0.5).

    Raises:
        InputError: a focal length is not positive or not in pixels, or the principal point is outside the image.
    """
    longest = MAX_FOCAL_SIDES * max(width, height)
    for name, focal in (("fl_x", fx), ("fl_y", fy)):
        if not MIN_FOCAL_PX <= focal <= longest:  # true for NaN too
            wanted, fix = f"a focal length in [{MIN_FOCAL_PX:g}, {longest:g}] pixels", "give it in pixels"
            if 0 < focal < MIN_FOCAL_PX:
                fix = "multiply it by the image's width or height if it is normalized"
            raise refusal(f"{where}.{name}", wanted=wanted, got=echo(focal), fix=fix)
    for name, center, extent in (("cx", cx, width), ("cy", cy, height)):
        if not 0 <= center <= extent:
            fix = "give the principal point in pixels of the stored image"
            raise refusal(f"{where}.{name}", wanted=f"a value in [0, {extent}]", got=echo(center), fix=fix)
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


# -- conventions ------------------------------------------------------------------------------------------------------

Axes = Literal["opencv", "opengl"]
"""Axes of a camera: +y down and +z forward (opencv), or +y up and +z backward (opengl)."""
Direction = Literal["camera-to-world", "world-to-camera"]  # direction of the matrices or vectors that a file gives


@dataclasses.dataclass(frozen=True)
class Convention:
    """Convention in which a file writes poses."""

    axes: Axes = "opencv"
    poses: Direction = "camera-to-world"

    def to_opencv(self, written: Pose) -> Pose:
        """The camera-to-world pose with OpenCV axes of a matrix in this convention."""
        camtoworld = written if self.poses == "camera-to-world" else invert_pose(written)
        return camtoworld if self.axes == "opencv" else camtoworld @ OPENGL_TO_OPENCV

    def from_opencv(self, camtoworld: Pose) -> Pose:
        """The matrix in this convention of a camera-to-world pose with OpenCV axes."""
        camtoworld = camtoworld if self.axes == "opencv" else camtoworld @ OPENGL_TO_OPENCV
        return camtoworld if self.poses == "camera-to-world" else invert_pose(camtoworld)

    def options(self, usual: "Convention") -> dict[str, str]:
        """The options that ask for this convention in place of the usual one."""
        return {name: getattr(self, name) for name in ("axes", "poses") if getattr(self, name) != getattr(usual, name)}


USUAL = Convention()  # the convention of captures in memory, and of formats that do not say otherwise

CONVENTIONS = tuple(Convention(axes, poses) for axes in get_args(Axes) for poses in get_args(Direction))

OPTIONS = {"axes": get_args(Axes), "poses": get_args(Direction), "depth": ("on", "off")}
"""Options behind the path of a capture, and their values; empty for any value."""


def split_options(path: str, allowed: Mapping[str, tuple[str, ...]] = OPTIONS) -> tuple[str, dict[str, str]]:
    """Splits `path?axes=...&poses=...&depth=...` into path and options; unknown and repeated values are refused."""
    option = f"(?:{'|'.join(allowed)})=[^&?/]*"
    found = re.search(rf"\?({option}(?:&{option})*)$", path)
    if found is None:
        return path, {}
    options: dict[str, str] = {}
    for part in found[1].split("&"):
        name, _, value = part.partition("=")
        if (allowed[name] and value not in allowed[name]) or name in options:
            got = "it twice" if name in options else echo(value)
            wanted = " or ".join(allowed[name]) or "one value"
            raise refusal(f"{path[: found.start()]}: {name}", wanted=wanted, got=got, fix="change the option")
        options[name] = value
    return path[: found.start()], options


def with_options(path: str, **given: str | None) -> str:
    """`path` with the options `axes`, `poses` and `depth` that are not None, which replace those that it has."""
    path, options = split_options(path)
    options |= {name: value for name, value in given.items() if value is not None}
    # A procedural path may have options of its own before these.
    mark = "" if not options else "&" if "?" in path else "?"
    return path + mark + "&".join(f"{name}={value}" for name, value in options.items())
