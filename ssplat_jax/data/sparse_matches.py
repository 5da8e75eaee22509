"""Sparse matches between two posed frames, and the test of poses and focal lengths by them.

    keypoints (ORB) -> matches near epipolar lines -> points: depths of a capture
    keypoints -> mutual matches, poses unused -> share consistent with the poses in each convention
                                              -> share consistent with longer and shorter focal lengths

In the test a match is consistent if it lies near its epipolar line and its point in front of the camera. Poses in a
wrong convention (camera axes, direction of the matrix) leave a small share of the matches consistent; in the right one
most are. So do focal lengths of another crop or size, within half the distance: a wrong one moves lines by a few
pixels. Poses that fit in no convention, though the matches agree on some motion, belong to other images or are wrong.

Everything is NumPy on the host; geometry is float64, in capture units.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int
from PIL import Image
from skimage import feature, measure, transform  # which load what is used of them, with scipy.stats, at its first use

from ssplat_jax.core.numerics import evenly_spread
from ssplat_jax.data.posed_image import CONVENTIONS, Convention, Frame, Matrix, Pose

LONG_SIDE = 320  # pixels of the working image; smaller images are enlarged, as ORB ignores a border of 16 pixels
MIN_SIDE = 48  # pixels of the working image; narrower images have no room for an ORB patch
NUM_KEYPOINTS = 400  # per image
FAST_THRESHOLD = 0.05  # of ORB's corner detector
NUM_OCTAVES = 4  # scales on which corners are sought
DOWNSCALE: Any = 1.4  # from one to the next; Any, because scikit-image calls it an integer
HARRIS_K = 0.04  # of the response by which corners are chosen
BORDER = 20  # pixels that a descriptor reaches in any direction
ORIENTATION_MASK = (np.hypot(*np.mgrid[-15:16, -15:16]) <= 15.4).astype(float)  # ORB's disk, whose centroid it follows
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
    def K(self, i: int) -> Matrix: ...
    def image(self, i: int) -> Float32[np.ndarray, "h w 3"]: ...
    def seen(self, i: int) -> Bool[np.ndarray, "h w"] | None: ...


@dataclasses.dataclass(frozen=True, eq=False)
class Keypoints:
    """Keypoints of an image."""

    pixels: Float64[np.ndarray, "n 2"]  # positions in the delivered image
    descriptors: Bool[np.ndarray, "n 256"] | Float32[np.ndarray, "n 128"]  # of ORB, or of SIFT
    pixel: float  # size of a working-image pixel in pixels of the delivered image


@dataclasses.dataclass(frozen=True, eq=False)
class CommonPoints:
    """Triangulated points that a pair of frames has in common."""

    inverse_depths: Float64[np.ndarray, " n"]  # in the first camera; negative behind it
    parallax: Float64[np.ndarray, " n"]  # degrees, with the sign of the inverse depth
    weights: Float64[np.ndarray, " n"]  # 1 / number of points in the same cell of the image
    close: Float64[np.ndarray, " m"]  # inverse depths of points with sufficient parallax from the nearest partner


KeypointsOf = Callable[[int], Keypoints]  # function that returns the keypoints of a frame
Vector = Float64[np.ndarray, "3"]
Rays = Float64[np.ndarray, "n 3"]


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
    places, descriptors = _strongest_corners(small)
    pixels = (places[:, ::-1] + 0.5) * np.array([width / size[0], height / size[1]])
    return Keypoints(pixels=pixels, descriptors=descriptors, pixel=shrink)


def _strongest_corners(image: Float64[np.ndarray, "h w"]) -> tuple[np.ndarray, np.ndarray]:
    """Places (row, column) and descriptors of the corners with the highest responses, on four scales.

    They are those of `ORB.detect_and_extract`, which takes half as long again: it describes all corners before it
    chooses among them.
    """
    octaves = [np.ascontiguousarray(octave) for octave in transform.pyramid_gaussian(image, NUM_OCTAVES - 1, DOWNSCALE)]
    corners = [_corners(octave) for octave in octaves]
    found = zip(octaves, corners, strict=True)
    responses = np.concatenate([feature.corner_harris(octave, k=HARRIS_K)[tuple(places.T)] for octave, places in found])
    order = np.arange(len(responses))
    if len(order) >= NUM_KEYPOINTS:
        order = np.argsort(responses)[: -NUM_KEYPOINTS - 1 : -1]
    ends = np.cumsum([0, *map(len, corners)])
    places, descriptors = np.zeros((len(order), 2)), np.zeros((len(order), 256), bool)
    for k, octave in enumerate(octaves):
        rows = np.flatnonzero((order >= ends[k]) & (order < ends[k + 1]))
        if len(rows):
            chosen = corners[k][order[rows] - ends[k]]
            angles = feature.corner_orientations(octave, chosen, ORIENTATION_MASK)
            describer: Any = feature.ORB(n_scales=1)
            describer.extract(octave, chosen.astype(np.float64), np.ones(len(rows)), angles)
            places[rows], descriptors[rows] = chosen * DOWNSCALE**k, describer.descriptors
    return places, descriptors


def _corners(image: Float64[np.ndarray, "h w"]) -> Int[np.ndarray, "n 2"]:
    """Places (row, column) of corners that have room for a descriptor; of two side by side, the stronger one."""
    taken, corners = np.zeros((image.shape[0] + 2, image.shape[1] + 2), bool), []
    for row, column in feature.peak_local_max(feature.corner_fast(image, 9, FAST_THRESHOLD), min_distance=1).tolist():
        if not taken[row : row + 3, column : column + 3].any():
            taken[row + 1, column + 1] = True
            corners.append((row, column))
    places = np.array(corners, int).reshape(-1, 2)
    return places[((places >= BORDER) & (places <= np.array(image.shape) - BORDER)).all(axis=1)]


def gray_image(image: Float32[np.ndarray, "h w 3"], size: tuple[int, int]) -> Float64[np.ndarray, "h2 w2"]:
    """An image in gray at another size (width, height)."""
    gray = Image.fromarray(np.ascontiguousarray(image @ np.array([0.299, 0.587, 0.114], np.float32)))
    return np.asarray(gray.resize(size, Image.Resampling.BICUBIC), np.float64)


def keypoints_of(capture: PosedImages) -> KeypointsOf:
    """A function that detects the keypoints of a frame of `capture` once and remembers them."""
    return functools.cache(lambda i: only_seen(detect_keypoints(capture.image(i)), capture.seen(i)))


def only_seen(keypoints: Keypoints, seen: Bool[np.ndarray, "h w"] | None) -> Keypoints:
    """The keypoints of an image that are not masked out."""
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


def motion_between(a: Pose, b: Pose) -> tuple[Matrix, Vector]:
    """Rotation and translation from camera a to camera b, whose camera-to-world poses are given."""
    return b[:3, :3].T @ a[:3, :3], b[:3, :3].T @ (a[:3, 3] - b[:3, 3])


def pixel_rays(K: Matrix, pixels: Float64[np.ndarray, "n 2"]) -> Rays:
    """The points at depth 1 on the rays through pixels."""
    return np.concatenate([(pixels - K[:2, 2]) / np.diag(K)[:2], np.ones((len(pixels), 1))], axis=-1)


def epipolar_distances(
    rays_a: Rays, rays_b: Float64[np.ndarray, "m 3"], R: Matrix, t: Vector
) -> Float64[np.ndarray, "n m"]:
    """The distance of each ray of camera b from the epipolar line of each ray of camera a.

    Rays have z = 1, and distances are in that plane of camera b; R and t lead from camera a to camera b.
    """
    lines = np.cross(t, rays_a @ R.T)
    return np.abs(lines @ rays_b.T) / np.maximum(np.linalg.norm(lines[:, :2], axis=-1), 1e-300)[:, None]


def match(
    descriptors_a: Bool[np.ndarray, "n d"], descriptors_b: Bool[np.ndarray, "m d"], allowed: Bool[np.ndarray, "n m"]
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
    rays_a: Rays, rays_b: Rays, R: Matrix, t: Vector
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


# -- test of poses -----------------------------------------------------------------------------------------------------


NUM_PAIRS = 8  # evenly spaced references, one partner each
GAPS = (1, 3, 8, 20)  # frames from a reference to its partner; the first with enough motion is taken
MIN_MOTION_PX = 10.0  # median motion of matches in the working image; with less, any epipolar line is near
MIN_MATCHES = 30  # per pair
MIN_TOTAL_MATCHES = 100  # with fewer, nothing is said
CLEAR_PARALLAX_DEGREES = 0.3  # points with less may triangulate behind the camera
GOOD_SHARE = 0.5  # of matches; right poses are consistent with more, however many matches are false
BETTER_RATIO = 1.5  # share of another convention over that of the given poses, from which it is named
FOCAL_FACTORS = tuple(
    factors for s in (0.5, 0.6, 0.7, 0.83, 1.2, 1.4, 1.7, 2.0) for factors in ((s, s), (s, 1.0), (1.0, s))
)  # of fx and fy as given, that are tried in their place
FOCAL_TOLERANCE = 0.5  # of the distance within which poses are tested
BETTER_FOCAL = 1.25  # share with other focal lengths over that with the given ones, from which they are named
POOR_SHARE = 0.6  # of the matches that agree on one motion; poses that are consistent with fewer are wrong


@dataclasses.dataclass(frozen=True, eq=False)
class MatchedPair:
    """Matches of two frames, found without their poses."""

    frames: tuple[Frame, Frame]
    rays: tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"]]  # points at depth 1
    pixels: tuple[Float64[np.ndarray, "n 2"], Float64[np.ndarray, "n 2"]]  # in the delivered images
    tolerance_px: float  # of a match's distance from its epipolar line, pixels of the delivered image
    focals: Float64[np.ndarray, "2"]  # fx and fy of the second image, pixels


@dataclasses.dataclass(frozen=True)
class PoseFit:
    """Shares of the matches that are consistent with the poses."""

    shares: dict[Convention, float]  # if the files were written in that convention
    focal_shares: dict[tuple[float, float], float]  # if fx and fy were so many times as long; within FOCAL_TOLERANCE
    coherent_share: float  # that agree on a motion between the frames, whatever it is


def matched_pairs(capture: PosedImages, indices: Sequence[int], keypoints: KeypointsOf) -> Iterator[MatchedPair]:
    """Yields pairs of frames with matches that move, references evenly spread over `indices`."""
    for reference in evenly_spread(max(len(indices) - 1, 0), NUM_PAIRS):
        for gap in GAPS:
            if reference + gap < len(indices):
                pair = _matched(capture, indices[reference], indices[reference + gap], keypoints)
                if pair is not None:
                    yield pair
                    break


def _matched(capture: PosedImages, i: int, j: int, keypoints: KeypointsOf) -> MatchedPair | None:
    """Matches of two frames, or None if they are few or hardly move."""
    a, b = keypoints(i), keypoints(j)
    rows, columns = match(a.descriptors, b.descriptors, np.ones((len(a.pixels), len(b.pixels)), bool))
    pixels = a.pixels[rows], b.pixels[columns]
    if len(rows) < MIN_MATCHES:
        return None
    if np.median(np.linalg.norm(pixels[1] - pixels[0], axis=1)) < MIN_MOTION_PX * b.pixel:
        return None
    rays = pixel_rays(capture.K(i), pixels[0]), pixel_rays(capture.K(j), pixels[1])
    frames = capture.frames[i], capture.frames[j]
    return MatchedPair(frames, rays, pixels, MAX_EPIPOLAR_PX * b.pixel, np.diag(capture.K(j))[:2])


def fit_poses(capture: PosedImages, convention: Convention, keypoints: KeypointsOf) -> PoseFit | None:
    """The fit of poses, read in `convention`, to the images in each convention; None if too few matches move."""
    counts, focals = dict.fromkeys(CONVENTIONS, 0), dict.fromkeys(((1.0, 1.0), *FOCAL_FACTORS), 0)
    total = coherent = 0
    for pair in matched_pairs(capture, range(len(capture.frames)), keypoints):
        total += len(pair.rays[0])
        coherent += _num_coherent(pair)
        a, b = (frame.camtoworld for frame in pair.frames)
        for other in CONVENTIONS:
            first, second = (other.to_opencv(convention.from_opencv(pose)) for pose in (a, b))
            counts[other] += _num_consistent(pair, first, second)
        for factors in focals:
            focals[factors] += _num_consistent(pair, a, b, factors, FOCAL_TOLERANCE)
    if total < MIN_TOTAL_MATCHES:
        return None
    shares = {other: count / total for other, count in counts.items()}
    focal_shares = {factors: count / total for factors, count in focals.items()}
    return PoseFit(shares=shares, focal_shares=focal_shares, coherent_share=coherent / total)


def _num_consistent(
    pair: MatchedPair, a: Pose, b: Pose, factors: tuple[float, float] = (1.0, 1.0), tolerance: float = 1.0
) -> int:
    """Number of matches near their epipolar lines whose points are in front of the first camera.

    `factors` are those of fx and fy, `tolerance` that of the distance from the line.
    """
    R, t = motion_between(a, b)
    rays_a, rays_b = (rays / [*factors, 1.0] for rays in pair.rays)
    if np.linalg.norm(t) == 0:
        return 0
    lines = np.cross(t, rays_a @ R.T)
    slopes = np.linalg.norm(lines[:, :2] / (pair.focals * factors), axis=-1)  # per pixel
    distances = np.abs(np.sum(lines * rays_b, axis=-1)) / np.maximum(slopes, 1e-300)
    inverse_depths, parallax = triangulate(rays_a, rays_b, R, t)
    in_front = (inverse_depths > 0) | (np.abs(parallax) < CLEAR_PARALLAX_DEGREES)
    return int(np.sum((distances < tolerance * pair.tolerance_px) & in_front))


def _num_coherent(pair: MatchedPair) -> int:
    """Number of matches that agree on one fundamental matrix, found by random sampling with a fixed seed."""
    options = {"min_samples": 8, "residual_threshold": pair.tolerance_px, "max_trials": 100, "rng": 0}
    _, inliers = measure.ransac(pair.pixels, transform.FundamentalMatrixTransform, **options)
    return 0 if inliers is None else int(np.sum(inliers))


def pose_warning(fit: PoseFit | None, convention: Convention) -> str | None:
    """A warning about poses in another convention, with the flags that mend them, or wrong focal lengths or poses."""
    if fit is None:
        return None
    given, best = fit.shares[convention], max(CONVENTIONS, key=lambda other: fit.shares[other])
    better = fit.shares[best]
    if better >= GOOD_SHARE * fit.coherent_share and better >= BETTER_RATIO * given:
        flags = " ".join(f"--{name} {value}" for name, value in best.options(convention).items())
        shares = f"{given:.0%} of the matches are consistent, and {better:.0%} would be"
        return f"Images and poses disagree: {shares} with {flags}; read the capture with them."
    focal = max(fit.focal_shares, key=lambda factors: fit.focal_shares[factors])
    as_given, better = fit.focal_shares[1.0, 1.0], fit.focal_shares[focal]
    if better >= GOOD_SHARE * fit.coherent_share and better >= BETTER_FOCAL * as_given:
        times = " and ".join(f"{s:g} times {name}" for s, name in zip(focal, ("fx", "fy"), strict=True) if s != 1.0)
        shares = f"{as_given:.0%} of the matches are consistent, and {better:.0%} would be with about {times}"
        fix = "check that the intrinsics are those of these images, as cropped or resized"
        return f"Images and focal lengths disagree: {shares}; {fix}."
    if given < POOR_SHARE * fit.coherent_share and fit.coherent_share >= GOOD_SHARE:
        shares = f"{given:.0%} of the matches are consistent with them, and {fit.coherent_share:.0%} with some motion"
        return f"Poses do not fit the images: {shares}; check that each pose belongs to its image, and intrinsics."
    return None
