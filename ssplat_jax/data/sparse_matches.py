"""Sparse matches between two posed frames: ORB keypoints, epipolar matching and triangulation.

Everything is NumPy on the host; geometry is float64, in capture units.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int
from PIL import Image
from skimage.feature import ORB

from ssplat_jax.data.posed_image import Frame

LONG_SIDE = 320  # pixels of the working image; smaller images are enlarged, as ORB ignores a border of 16 pixels
MIN_SIDE = 48  # pixels of the working image; narrower images have no room for an ORB patch
NUM_KEYPOINTS = 400  # per image
FAST_THRESHOLD = 0.05  # of ORB's corner detector
FULL_CONTRAST = 0.5  # between the 1 % and 99 % quantiles of gray; images with less contrast are stretched to it
MAX_STRETCH = 20.0  # largest factor of that stretch
MAX_HAMMING = 72  # of 256 bits
MAX_RATIO = 0.85  # Lowe's test: best over second-best descriptor distance
MAX_EPIPOLAR_PX = 2.0  # pixels of the working image
MIN_POINTS = 10  # pairs of frames with fewer common points are not used
CELL = 40  # pixels of the working image; the points of a cell together have weight 1


@runtime_checkable
class PosedImages(Protocol):
    """Part of a `Capture` that matching needs."""

    @property
    def frames(self) -> Sequence[Frame]: ...
    def K(self, i: int) -> Float64[np.ndarray, "3 3"]: ...
    def image(self, i: int) -> Float32[np.ndarray, "h w 3"]: ...
    def seen(self, i: int) -> Bool[np.ndarray, "h w"] | None: ...


@dataclasses.dataclass(frozen=True, eq=False)
class Keypoints:
    """ORB keypoints of an image."""

    pixels: Float64[np.ndarray, "n 2"]  # positions in the delivered image
    descriptors: Bool[np.ndarray, "n 256"]
    pixel: float  # size of a working-image pixel in pixels of the delivered image


@dataclasses.dataclass(frozen=True, eq=False)
class CommonPoints:
    """Triangulated points that a pair of frames has in common."""

    inverse_depths: Float64[np.ndarray, " n"]  # in the first camera; negative behind it
    parallax: Float64[np.ndarray, " n"]  # degrees, with the sign of the inverse depth
    weights: Float64[np.ndarray, " n"]  # 1 / number of points in the same cell of the image
    close: Float64[np.ndarray, " m"]  # inverse depths of points with sufficient parallax from the nearest partner


KeypointsOf = Callable[[int], Keypoints]
"""Function that returns the keypoints of a frame."""


def detect_keypoints(image: Float32[np.ndarray, "h w 3"]) -> Keypoints:
    """The ORB keypoints of an image; there are none if it is too narrow or has no corners."""
    height, width = image.shape[:2]
    shrink = max(height, width) / LONG_SIDE
    nothing = Keypoints(pixels=np.zeros((0, 2)), descriptors=np.zeros((0, 256), bool), pixel=shrink)
    size = (round(width / shrink), round(height / shrink))
    if min(size) < MIN_SIDE:
        return nothing
    small = gray_image(image, size)
    dark, bright = np.quantile(small, [0.01, 0.99])
    if bright - dark < FULL_CONTRAST:  # night or fog: corners are equally sharp, but faint
        small = (small - dark) * min(FULL_CONTRAST / max(bright - dark, 1e-9), MAX_STRETCH)
    detector: Any = ORB(n_keypoints=NUM_KEYPOINTS, n_scales=4, downscale=1.4, fast_threshold=FAST_THRESHOLD)
    try:
        detector.detect_and_extract(small)
    except RuntimeError:  # skimage raises it for an image without corners
        return nothing
    pixels = (detector.keypoints[:, ::-1] + 0.5) * np.array([width / size[0], height / size[1]])
    return Keypoints(pixels=pixels, descriptors=detector.descriptors.astype(bool), pixel=shrink)


def gray_image(image: Float32[np.ndarray, "h w 3"], size: tuple[int, int]) -> Float64[np.ndarray, "h2 w2"]:
    """An image in gray at another size (width, height)."""
    gray = Image.fromarray(np.ascontiguousarray(image @ np.array([0.299, 0.587, 0.114], np.float32)))
    return np.asarray(gray.resize(size, Image.Resampling.BICUBIC), np.float64)


def keypoints_of(capture: PosedImages) -> KeypointsOf:
    """A function that detects the keypoints of a frame of `capture` once and remembers them."""
    return functools.cache(lambda i: only_seen(detect_keypoints(capture.image(i)), capture.seen(i)))


def only_seen(keypoints: Any, seen: Bool[np.ndarray, "h w"] | None) -> Any:
    """The keypoints (with `pixels` and `descriptors`) of an image that are not masked out."""
    if seen is None:
        return keypoints
    columns, rows = keypoints.pixels.astype(int).T
    kept = seen[rows.clip(0, seen.shape[0] - 1), columns.clip(0, seen.shape[1] - 1)]
    return dataclasses.replace(keypoints, pixels=keypoints.pixels[kept], descriptors=keypoints.descriptors[kept])


def triangulate_pair(capture: PosedImages, i: int, j: int, keypoints: KeypointsOf) -> CommonPoints | None:
    """Triangulates the points that two frames have in common, as seen by frame `i`; None if they are few."""
    a, b = capture.frames[i].camtoworld, capture.frames[j].camtoworld
    R, t = motion_between(a, b)
    ka, kb = keypoints(i), keypoints(j)
    rays_a, rays_b = pixel_rays(capture.K(i), ka.pixels), pixel_rays(capture.K(j), kb.pixels)
    near_line = epipolar_distances(rays_a, rays_b, R, t) < MAX_EPIPOLAR_PX * kb.pixel / capture.K(j)[0, 0]
    idx_a, idx_b = match(ka.descriptors, kb.descriptors, near_line)
    if len(idx_a) < MIN_POINTS:
        return None
    inverse_depths, parallax = triangulate(rays_a[idx_a], rays_b[idx_b], R, t)
    cells = (ka.pixels[idx_a] / (CELL * ka.pixel)).astype(int)
    _, cell, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    weights = 1 / counts[cell.ravel()]
    return CommonPoints(inverse_depths=inverse_depths, parallax=parallax, weights=weights, close=np.zeros(0))


def motion_between(
    a: Float64[np.ndarray, "4 4"], b: Float64[np.ndarray, "4 4"]
) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, "3"]]:
    """Rotation and translation from camera a to camera b, whose camera-to-world poses are given."""
    return b[:3, :3].T @ a[:3, :3], b[:3, :3].T @ (a[:3, 3] - b[:3, 3])


def pixel_rays(K: Float64[np.ndarray, "3 3"], pixels: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 3"]:
    """The points at depth 1 on the rays through pixels."""
    return np.concatenate([(pixels - K[:2, 2]) / np.diag(K)[:2], np.ones((len(pixels), 1))], axis=-1)


def epipolar_distances(
    rays_a: Float64[np.ndarray, "n 3"],
    rays_b: Float64[np.ndarray, "m 3"],
    R: Float64[np.ndarray, "3 3"],
    t: Float64[np.ndarray, "3"],
) -> Float64[np.ndarray, "n m"]:
    """The distance of each ray of camera b from the epipolar line of each ray of camera a.

    Rays have z = 1, and distances are in that plane of camera b; R and t lead from camera a to camera b.
    """
    lines = np.cross(t, rays_a @ R.T)
    return np.abs(lines @ rays_b.T) / np.maximum(np.linalg.norm(lines[:, :2], axis=-1), 1e-300)[:, None]


def match(
    descriptors_a: Bool[np.ndarray, "n bits"],
    descriptors_b: Bool[np.ndarray, "m bits"],
    allowed: Bool[np.ndarray, "n m"],
) -> tuple[Int[np.ndarray, " p"], Int[np.ndarray, " p"]]:
    """The rows of `descriptors_a` and `descriptors_b` that are mutual nearest neighbors among `allowed` pairs.

    Matches must be within `MAX_HAMMING` bits and clearly nearer than the second best (`MAX_RATIO`). Because poses are
    known, the epipolar lines leave a few candidates each; this gives up to twice as many matches as an unrestricted
    search, with fewer false ones.
    """
    bits = descriptors_a.shape[1]
    a, b = (2.0 * d.astype(np.float32) - 1.0 for d in (descriptors_a, descriptors_b))
    hamming = np.where(allowed, (bits - a @ b.T) / 2, bits)
    return mutual_nearest(hamming, float(MAX_HAMMING), MAX_RATIO)


def mutual_nearest(
    distances: Float[np.ndarray, "n m"], max_distance: float, max_ratio: float
) -> tuple[Int[np.ndarray, " p"], Int[np.ndarray, " p"]]:
    """The rows and columns that are nearest to each other and at most `max_distance` apart.

    A row's smallest distance must be less than `max_ratio` of its second smallest (Lowe's test).
    """
    if min(distances.shape) < 2:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    rows, nearest = np.arange(len(distances)), distances.argmin(axis=1)
    best, second = np.partition(distances, 1, axis=1)[:, :2].T
    is_mutual = distances.argmin(axis=0)[nearest] == rows
    keep = is_mutual & (best <= max_distance) & (best < max_ratio * second)
    return rows[keep], nearest[keep]


def triangulate(
    rays_a: Float64[np.ndarray, "n 3"],
    rays_b: Float64[np.ndarray, "n 3"],
    R: Float64[np.ndarray, "3 3"],
    t: Float64[np.ndarray, "3"],
) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """The inverse depths in camera a where pairs of rays come closest, and the angles between them in degrees.

    Both are 0 for parallel rays, and negative for rays that meet behind camera a. Rays have z = 1, so that lengths
    along them are depths; R and t lead from camera a to camera b.
    """
    along = rays_a @ R.T
    bb, ab = (rays_b * rays_b).sum(-1), (along * rays_b).sum(-1)
    # depth = ahead / sine2; towards infinity both vanish, sine2 faster.
    ahead = ab * (rays_b @ t) - bb * (along @ t)
    sine2 = (np.cross(along, rays_b) ** 2).sum(-1)
    inverse_depths = np.where(ahead == 0, 0.0, sine2 / np.where(ahead == 0, 1.0, ahead))
    return inverse_depths, np.copysign(np.degrees(np.arctan2(np.sqrt(sine2), ab)), inverse_depths)
