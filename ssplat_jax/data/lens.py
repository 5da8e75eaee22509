"""Lens distortion by the Brown-Conrady or the fish-eye model (both as in OpenCV), and undistortion of images."""

import dataclasses

import numpy as np
from jaxtyping import Float32, Float64
from skimage.transform import warp

from ssplat_jax.core.errors import refusal

IGNORED_PX = 0.5  # images with a smaller displacement by distortion are not undistorted


@dataclasses.dataclass(frozen=True)
class Lens:
    """Distortion coefficients: x_d = x (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) + 2 p1 x y + p2 (r^2 + 2 x^2)."""

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    def distorted(self, points: Float64[np.ndarray, "*n 2"]) -> Float64[np.ndarray, "*n 2"]:
        """Maps points on the plane z = 1 of the pinhole camera to their distorted positions."""
        x, y = points[..., 0], points[..., 1]
        with np.errstate(over="ignore", invalid="ignore"):
            r2 = x * x + y * y
            radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * (self.k3 + r2 * self.k4)))
            return np.stack(
                [
                    x * radial + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x),
                    y * radial + self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y,
                ],
                axis=-1,
            )

    def pixels(self, K: Float64[np.ndarray, "3 3"], points: Float64[np.ndarray, "*n 2"]) -> Float64[np.ndarray, "*n 2"]:
        """Maps pixels of the pinhole image to pixels of the distorted one; both have the intrinsics `K`."""
        center, focal = K[:2, 2], np.diag(K)[:2]
        with np.errstate(over="ignore", invalid="ignore"):
            return self.distorted((points - center) / focal) * focal + center


@dataclasses.dataclass(frozen=True)
class FisheyeLens(Lens):
    """Fish-eye lens: a ray at the angle a to the axis is seen at r = a (1 + k1 a^2 + k2 a^4 + k3 a^6 + k4 a^8).

    This is COLMAP's OPENCV_FISHEYE, and without coefficients an equidistant lens. `p1` and `p2` have no meaning here.

    Limits:
        Rays at 90 degrees and more to the axis have no place in a pinhole image and are not delivered.
        On the axis the lens is the identity.
    """

    def distorted(self, points: Float64[np.ndarray, "*n 2"]) -> Float64[np.ndarray, "*n 2"]:
        """Maps points on the plane z = 1 of the pinhole camera to their distorted positions."""
        with np.errstate(over="ignore", invalid="ignore"):
            radius = np.linalg.norm(points, axis=-1, keepdims=True)
            a2 = np.square(np.arctan(radius))
            series = 1 + a2 * (self.k1 + a2 * (self.k2 + a2 * (self.k3 + a2 * self.k4)))
            shrink = np.where(radius > 1e-9, np.arctan(radius) / np.maximum(radius, 1e-9), 1.0)
            return points * shrink * series


PINHOLE = Lens()  # no distortion


def check_lens(lens: Lens, K: Float64[np.ndarray, "3 3"], width: int, height: int, where: str) -> float:
    """Returns the largest displacement by distortion on the border of the image, in pixels.

    Args:
        lens: the distortion.
        K: intrinsics in pixels.
        width: image width in pixels.
        height: image height in pixels.
        where: location of the coefficients for error messages.

    Returns:
        The displacement in pixels; exactly 0 without distortion.

    Raises:
        InputError: the distortion folds the image or moves pixels by more than the image size, so the coefficients
            probably belong to another model.
    """
    t = np.linspace(0.0, 1.0, 9)
    edge = np.concatenate([np.stack(np.broadcast_arrays(t, s), -1) for s in (0.0, 1.0)])
    border = np.concatenate([edge, edge[:, ::-1]]) * (width, height)
    spokes = K[:2, 2] + np.linspace(0.0, 1.0, 33)[:, None, None] * (
        border - K[:2, 2]
    )  # lines from the principal point to the border
    moved = lens.pixels(K, spokes)
    with np.errstate(over="ignore", invalid="ignore"):
        rays = (border - K[:2, 2]) / np.diag(K)[:2]
        shift = np.linalg.norm((lens.distorted(rays) - rays) * np.diag(K)[:2], axis=-1)  # exactly 0 without distortion
        shift = float(np.nan_to_num(shift.max(), nan=np.inf))
        outwards = np.einsum("ksi,ksi->ks", np.diff(moved, axis=0), np.diff(spokes, axis=0))
    if shift > max(width, height) or not (outwards[:, np.linalg.norm(spokes[-1] - spokes[0], axis=-1) > 0] > 0).all():
        shown = ", ".join(f"{name}={value:.3g}" for name, value in dataclasses.asdict(lens).items() if value != 0)
        fix = "check the coefficients, or undistort first (COLMAP: `colmap image_undistorter`) and set k1..p2 to 0"
        raise refusal(where, wanted="a lens that does not fold the image", got=shown, fix=fix)
    return shift


def undistort(
    image: Float32[np.ndarray, "h w *c"],
    lens: Lens,
    K: Float64[np.ndarray, "3 3"],
    *,
    order: int = 1,
    outside: float | None = None,
) -> Float32[np.ndarray, "h w *c"]:
    """Returns the image that a pinhole camera would have taken.

    Args:
        image: the distorted image, or a depth map.
        lens: its distortion.
        K: intrinsics of both images, in pixels.
        order: 1 samples linearly, 0 takes the nearest pixel (for depth maps).
        outside: value of pixels that the stored image does not show; by default they repeat its border.

    Returns:
        The undistorted image.
    """
    mode, fill = ("edge", 0.0) if outside is None else ("constant", outside)
    rows, columns = np.mgrid[: image.shape[0], : image.shape[1]]
    pixels = lens.pixels(K, np.stack([columns, rows], axis=-1) + 0.5) - 0.5
    at = np.moveaxis(pixels[..., ::-1], -1, 0)
    planes = [
        warp(plane, at, order=order, mode=mode, cval=fill, preserve_range=True).astype(np.float32)
        for plane in np.moveaxis(image.reshape(*image.shape[:2], -1), -1, 0)
    ]
    return np.stack(planes, axis=-1).reshape(image.shape)
