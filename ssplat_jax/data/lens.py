"""Lens distortion of stored images by Brown's model (OpenCV's), and images as by a pinhole camera."""

import dataclasses

import numpy as np
from jaxtyping import Float32, Float64
from skimage.transform import warp

from ssplat_jax.errors import refusal

IGNORED_PX = 0.5  # images whose pixels move by no more are left as they are


@dataclasses.dataclass(frozen=True)
class Lens:
    """x_d = x (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) + 2 p1 x y + p2 (r^2 + 2 x^2), and y_d likewise."""

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    def distorted(self, points: Float64[np.ndarray, "*n 2"]) -> Float64[np.ndarray, "*n 2"]:
        """Where points of the pinhole camera's plane z = 1 appear through the lens."""
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
        """Pixels of the distorted image for pixels of the pinhole one; both have intrinsics `K`."""
        center, focal = K[:2, 2], np.diag(K)[:2]
        with np.errstate(over="ignore", invalid="ignore"):
            return self.distorted((points - center) / focal) * focal + center


PINHOLE = Lens()


def check_lens(lens: Lens, K: Float64[np.ndarray, "3 3"], width: int, height: int, where: str) -> float:
    """Largest displacement in pixels on the image's border.

    Limits:
        A lens that folds the image, or throws pixels farther than the image is large, is refused: such coefficients
        belong to another model.
    """
    t = np.linspace(0.0, 1.0, 9)
    edge = np.concatenate([np.stack(np.broadcast_arrays(t, s), -1) for s in (0.0, 1.0)])
    border = np.concatenate([edge, edge[:, ::-1]]) * (width, height)
    spokes = K[:2, 2] + np.linspace(0.0, 1.0, 33)[:, None, None] * (border - K[:2, 2])  # principal point to border
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


def undistorted(
    image: Float32[np.ndarray, "h w *c"], lens: Lens, K: Float64[np.ndarray, "3 3"], *, order: int = 1
) -> Float32[np.ndarray, "h w *c"]:
    """The image that a pinhole camera of intrinsics `K` would have taken.

    Sampled linearly (`order` 0: nearest, for depth); what lies beyond the stored image repeats its border.
    """
    rows, columns = np.mgrid[: image.shape[0], : image.shape[1]]
    pixels = lens.pixels(K, np.stack([columns, rows], axis=-1) + 0.5) - 0.5
    at = np.moveaxis(pixels[..., ::-1], -1, 0)
    planes = [
        warp(plane, at, order=order, mode="edge", preserve_range=True).astype(np.float32)
        for plane in np.moveaxis(image.reshape(*image.shape[:2], -1), -1, 0)
    ]
    return np.stack(planes, axis=-1).reshape(image.shape)
