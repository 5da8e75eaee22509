"""How deep a capture is, from its images and poses alone: keypoints matched between nearby frames, triangulated.

    ORB keypoints -> mutual matches near the epipolar lines -> inverse depths and parallax -> quantiles

Everything is NumPy on the host, geometry in float64 and capture units, on images of 320 pixels; some seconds
per capture. Only the frames given are looked at, so the targets of an evaluation cannot leak into near, far and scale.

Depths are kept as *signed inverse* depths until the last step: with little parallax a point's error is symmetric in
inverse depth and may take it past infinity. Dropping such points, or those of little parallax, would pull the median
towards the camera (by 30 % at a median parallax of 1 degree); the median of all signed ones stays in place.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int
from PIL import Image
from skimage.feature import ORB

from ssplat_jax.config import StreamConfig
from ssplat_jax.data.posed_image import Frame

# Keypoints and matches
LONG_SIDE = 320  # pixels of the working images; small ones grow, since ORB sees nothing within 16 pixels of the border
MIN_SIDE = 48  # narrower strips leave no room for an ORB patch
NUM_KEYPOINTS = 400
FAST_THRESHOLD = 0.05
FULL_CONTRAST = 0.5  # between the 1 % and 99 % quantiles of gray: images of less are stretched to it, ...
MOST_STRETCH = 20.0  # ... by this much at most
MAX_HAMMING = 72  # of 256 bits
MAX_RATIO = 0.85  # Lowe's test: best over second-best descriptor distance
MAX_EPIPOLAR_PX = 2.0  # of the working images
# Which pairs
NUM_REFERENCES = 16  # frames, evenly spread, that look for a partner
MAX_AXIS_DEGREES = 40.0  # ORB does not survive larger changes of view
MIN_POINTS = 10  # a pair with fewer common points is no pair
GOOD_PARALLAX_DEGREES = 4.0  # median parallax at which a reference stops looking for a wider partner
POOR_PARALLAX_DEGREES = 0.5  # pairs of less tell the median roughly, and nothing about the range
# Which points
ROUNDING = 1e-12  # of poses, against how far from the origin they lie (or 1): cameras this near stand in one place

CELL = 40  # pixels of the working images: points of one cell share one vote on the median
MIN_TOTAL_POINTS = 30  # with fewer, depths are guessed from baselines
FAR_PARALLAX_DEGREES = 1.5  # points of less are too uncertain to say how far the scene reaches
MOST_POINTS = 0.9  # if fewer of all points than this have it, ...
FEW_PAIRS = 12  # ... or fewer pairs than this were found, so that backgrounds may have been missed, ...
MIN_REACH = 2.3  # ... the 99 % quantile is taken to be at least this many medians
PARALLAX_ERROR = 0.15  # degrees, of a triangulated point: most of a pixel of the working images
BEYOND = 0.1  # share of the image that may surely lie beyond far; where a background fills more, far goes there
CLOSE_SHARE = 0.15  # of the points of a nearest partner with parallax enough to count; false matches are fewer
CLOSE_POINTS = 0.9  # quantile, in inverse depth, of what a nearest partner matches: false matches are beyond it
# Guesses
GUESSED_SPREAD = 4.0  # median over the 1 % quantile, and 99 % over the median, where nothing tells
BASELINE_DEPTH = 5.0  # median depth over the median step between frames, where nothing matches
# From quantiles to the depth range
NEAR_FACTOR = 0.55  # of the 1 % quantile: keypoints miss the nearest surfaces
FAR_FACTOR = 1.8  # of the 99 % quantile: and the farthest
MIN_RANGE, MAX_RANGE = 4.0, 60.0  # far / near
NEAREST = 1 / 8  # of the median: a range that is too wide loses what is nearer than this before it loses what is far


@runtime_checkable
class PosedImages(Protocol):
    """What is needed of a capture."""

    @property
    def frames(self) -> Sequence[Frame]:
        """The frames as stored."""
        ...

    def K(self, i: int) -> Float64[np.ndarray, "3 3"]:
        """Intrinsics of the image."""
        ...

    def image(self, i: int) -> Float32[np.ndarray, "h w 3"]:
        """RGB in [0, 1]."""
        ...


@dataclasses.dataclass(frozen=True)
class DepthStatistics:
    """Quantiles of the depths of sparse points in front of the cameras, capture units."""

    q01: float
    median: float
    q99: float
    num_points: int
    num_pairs: int
    parallax_degrees: float  # median over the points; 0 without any
    source: str  # "matches"; "poor parallax": the median only; "baselines": a guess

    @property
    def warning(self) -> str | None:
        """What to tell a user about a measurement that failed."""
        if self.source == "baselines":
            return (
                "Hardly any matches between frames: depth, near, far and scale are guessed from the steps between"
                " cameras; check poses and axes, or set the scene scale."
            )
        if self.source == "poor parallax":
            return (
                "Low parallax: near and far are guessed around the median depth; take frames farther apart (--stride)."
            )
        return None


@dataclasses.dataclass(frozen=True, eq=False)
class _Keypoints:
    pixels: Float64[np.ndarray, "n 2"]  # of the delivered image
    descriptors: Bool[np.ndarray, "n 256"]
    pixel: float  # size of a pixel of the working image in delivered ones


@dataclasses.dataclass(frozen=True, eq=False)
class _Points:
    """What a pair of frames sees together."""

    inverse_depths: Float64[np.ndarray, " n"]  # in the first camera, signed
    parallax: Float64[np.ndarray, " n"]  # degrees, same sign
    weights: Float64[np.ndarray, " n"]  # 1 / points in the same cell of the image
    close: Float64[np.ndarray, " m"]  # inverse depths, with parallax enough, that the nearest partner gives


_KeypointsOf = Callable[[int], _Keypoints]


def estimate_depths(capture: PosedImages, indices: Sequence[int]) -> DepthStatistics:
    """Quantiles of the depth of what the frames `indices` see.

    Limits:
        Median parallax below 0.5 degrees: the median alone is measured, the range is a factor of 4 to both sides.
        No matches (one frame, a pure rotation, bare walls): 5 median steps between frames, or 1 without any step.
    """
    keypoints = functools.cache(lambda i: _keypoints(capture.image(i)))
    references = np.unique(np.linspace(0, len(indices) - 1, min(NUM_REFERENCES, len(indices))).round().astype(int))
    pairs: list[_Points] = []
    baseline = 0.0
    for reference in references:
        points = _best_pair(capture, indices[reference], indices, baseline, keypoints)
        if points is not None:
            pairs.append(points)
            inverse_depth = _median(pairs)
            baseline = math.radians(GOOD_PARALLAX_DEGREES) / max(inverse_depth, 1e-300)
    good = [p for p in pairs if np.median(p.parallax) >= POOR_PARALLAX_DEGREES]
    if sum(p.parallax.size for p in good) >= MIN_TOTAL_POINTS and _median(good) > 0:
        return _statistics(good)
    if sum(p.parallax.size for p in pairs) >= MIN_TOTAL_POINTS:
        inverse_depth = _median(pairs)
        if inverse_depth > 0:
            return _guess(1 / inverse_depth, "poor parallax", pairs)
    steps = np.linalg.norm(np.diff(np.stack([capture.frames[i].center for i in indices]), axis=0), axis=-1)
    steps = steps[steps > still(capture)]
    return _guess(BASELINE_DEPTH * float(np.median(steps)) if steps.size else 1.0, "baselines", [])


def still(capture: PosedImages) -> float:
    """How far apart two cameras may be that stand in one place: poses are rounded, as by inverting their matrices."""
    return ROUNDING * max(1.0, *(float(np.abs(frame.center).max()) for frame in capture.frames))


def stream_scale(depths: DepthStatistics, config: StreamConfig) -> tuple[float, float, float]:
    """(scale, near, far): stream units per capture unit, and the depth range in stream units.

    Limits:
        far / near stays in [4, 60]: widened to both sides; or cut, at the near end up to an eighth of the median, then
        at the far end.
    """
    scale = (
        config.stream.median_depth / depths.median
        if config.stream.scene_scale == "auto"
        else float(config.stream.scene_scale)
    )
    near, far = NEAR_FACTOR * depths.q01, FAR_FACTOR * depths.q99
    widen = max(1.0, math.sqrt(MIN_RANGE * near / far))
    near, far = near / widen, far * widen
    near = max(near, min(far / MAX_RANGE, NEAREST * depths.median))
    return scale, scale * near, scale * min(far, near * MAX_RANGE)


def _statistics(pairs: list[_Points]) -> DepthStatistics:
    """Quantiles from pairs of sufficient parallax."""
    inverse = np.concatenate([p.inverse_depths for p in pairs])
    parallax = np.concatenate([p.parallax for p in pairs])
    close = np.concatenate([p.close for p in pairs])
    nearest = max(np.quantile(inverse, 0.99), np.quantile(close, CLOSE_POINTS) if close.size else 0.0)
    middle = _median(pairs)
    reached = inverse[parallax >= FAR_PARALLAX_DEGREES]
    reach = 1 / np.quantile(reached, 0.01) if reached.size else 0.0
    if reached.size < MOST_POINTS * inverse.size or len(pairs) < FEW_PAIRS:
        reach = max(reach, MIN_REACH / middle)
    least = _least_inverse_depth(pairs)
    if least < 1 / (FAR_FACTOR * reach):
        farthest = MAX_RANGE * NEAR_FACTOR / (FAR_FACTOR * nearest)
        reach = max(reach, min(1 / least, farthest))
    return DepthStatistics(
        q01=float(1 / nearest),
        median=float(1 / middle),
        q99=float(reach),
        num_points=inverse.size,
        num_pairs=len(pairs),
        parallax_degrees=float(np.median(parallax)),
        source="matches",
    )


def _guess(median: float, source: str, pairs: list[_Points]) -> DepthStatistics:
    """Quantiles around a median, where nothing tells the range."""
    return DepthStatistics(
        q01=median / GUESSED_SPREAD,
        median=median,
        q99=median * GUESSED_SPREAD,
        num_points=sum(p.parallax.size for p in pairs),
        num_pairs=len(pairs),
        parallax_degrees=float(np.median(np.concatenate([p.parallax for p in pairs]))) if pairs else 0.0,
        source=source,
    )


def _best_pair(
    capture: PosedImages, i: int, others: Sequence[int], baseline: float, keypoints: _KeypointsOf
) -> _Points | None:
    """Points of frame `i` and the nearest partner with enough parallax; `baseline` is a guess at how far it is.

    Partners are tried from the guess outwards until parallax suffices or matches run out, else inwards.
    """
    partners, distances = _partners(capture, i, others)
    count = len(partners)
    ladder = sorted({min(2**k, count) - 1 for k in range(count.bit_length() + 1)}) if count else []
    start = next((k for k, rank in enumerate(ladder) if distances[rank] >= baseline), max(len(ladder) - 1, 0))
    best = None
    for rank in ladder[start:]:
        points = _triangulated(capture, i, partners[rank], keypoints)
        if points is None:
            break
        best = points
        if np.median(points.parallax) >= GOOD_PARALLAX_DEGREES:
            break
    for rank in reversed(ladder[:start]):
        if best is not None:
            break
        best = _triangulated(capture, i, partners[rank], keypoints)
    if best is None:
        return None
    # What is close turns out of view first: with a wide baseline, the background alone would say what is near.
    nearest = _triangulated(capture, i, partners[0], keypoints)
    if nearest is None:
        return best
    close = nearest.inverse_depths[nearest.parallax >= FAR_PARALLAX_DEGREES]
    is_some = close.size >= max(MIN_POINTS, CLOSE_SHARE * nearest.parallax.size)
    return dataclasses.replace(best, close=close) if is_some else best


def _partners(capture: PosedImages, i: int, others: Sequence[int]) -> tuple[list[int], Float64[np.ndarray, " n"]]:
    """The frames that look about the same way as frame `i` from elsewhere, nearest first, and how far away they are.

    Near in space, not in time: a photo set has no order, and a walk comes back.
    """
    frame = capture.frames[i]
    offsets = np.stack([capture.frames[j].center for j in others]) - frame.center
    axes = np.stack([capture.frames[j].camtoworld[:3, 2] for j in others])
    distances = np.linalg.norm(offsets, axis=-1)
    is_partner = (axes @ frame.camtoworld[:3, 2] > math.cos(math.radians(MAX_AXIS_DEGREES))) & (
        distances > still(capture)
    )
    order = [int(k) for k in np.argsort(distances, kind="stable") if is_partner[k]]
    return [others[k] for k in order], distances[order]


def _keypoints(image: Float32[np.ndarray, "h w 3"]) -> _Keypoints:
    """ORB keypoints of an image."""
    height, width = image.shape[:2]
    shrink = max(height, width) / LONG_SIDE
    nothing = _Keypoints(pixels=np.zeros((0, 2)), descriptors=np.zeros((0, 256), bool), pixel=shrink)
    size = (round(width / shrink), round(height / shrink))
    if min(size) < MIN_SIDE:
        return nothing
    gray = Image.fromarray(np.ascontiguousarray(image @ np.array([0.299, 0.587, 0.114], np.float32)))
    small = np.asarray(gray.resize(size, Image.Resampling.BICUBIC), np.float64)
    dark, bright = np.quantile(small, [0.01, 0.99])
    if bright - dark < FULL_CONTRAST:  # night, fog: corners are as sharp there, only fainter
        small = (small - dark) * min(FULL_CONTRAST / max(bright - dark, 1e-9), MOST_STRETCH)
    detector: Any = ORB(n_keypoints=NUM_KEYPOINTS, n_scales=4, downscale=1.4, fast_threshold=FAST_THRESHOLD)
    try:
        detector.detect_and_extract(small)
    except RuntimeError:  # skimage's answer to an image without corners
        return nothing
    pixels = (detector.keypoints[:, ::-1] + 0.5) * np.array([width / size[0], height / size[1]])
    return _Keypoints(pixels=pixels, descriptors=detector.descriptors.astype(bool), pixel=shrink)


def _triangulated(capture: PosedImages, i: int, j: int, keypoints: _KeypointsOf) -> _Points | None:
    """The points that frames `i` and `j` both see; None if they are too few."""
    a, b = capture.frames[i].camtoworld, capture.frames[j].camtoworld
    R, t = b[:3, :3].T @ a[:3, :3], b[:3, :3].T @ (a[:3, 3] - b[:3, 3])  # camera i -> camera j
    ka, kb = keypoints(i), keypoints(j)
    rays_a, rays_b = _rays(capture.K(i), ka.pixels), _rays(capture.K(j), kb.pixels)
    near_line = epipolar_distances(rays_a, rays_b, R, t) < MAX_EPIPOLAR_PX * kb.pixel / capture.K(j)[0, 0]
    idx_a, idx_b = match(ka.descriptors, kb.descriptors, near_line)
    if len(idx_a) < MIN_POINTS:
        return None
    inverse_depths, parallax = triangulate(rays_a[idx_a], rays_b[idx_b], R, t)
    cells = (ka.pixels[idx_a] / (CELL * ka.pixel)).astype(int)
    _, cell, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    weights = 1 / counts[cell.ravel()]
    return _Points(inverse_depths=inverse_depths, parallax=parallax, weights=weights, close=np.zeros(0))


def _median(pairs: list[_Points]) -> float:
    """Median inverse depth by area of the image: keypoints crowd on what is rich in corners, near or far."""
    return _quantile_by_area(pairs, [p.inverse_depths for p in pairs], 0.5)


def _quantile_by_area(pairs: list[_Points], values: list[Float64[np.ndarray, " _"]], share: float) -> float:
    """The value that `share` of the image has less than."""
    flat, weights = np.concatenate(values), np.concatenate([p.weights for p in pairs])
    order = np.argsort(flat)
    cumulative = np.cumsum(weights[order])
    return float(flat[order][np.searchsorted(cumulative, share * cumulative[-1])])


def _least_inverse_depth(pairs: list[_Points]) -> float:
    """What the `BEYOND` farthest of the image are surely below, error and all. Points surely behind are false."""
    bounds = [p.inverse_depths + _error(p) for p in pairs]
    return _quantile_by_area(pairs, [np.where(b > 0, b, np.inf) for b in bounds], BEYOND)


def _error(points: _Points) -> Float64[np.ndarray, " n"]:
    """Of the inverse depths of a pair: parallax tells little about what lies near the direction of motion."""
    moved = points.parallax != 0
    slopes = np.abs(points.inverse_depths / np.where(moved, points.parallax, 1.0))
    return np.where(moved, PARALLAX_ERROR * slopes, np.inf)


def _rays(K: Float64[np.ndarray, "3 3"], pixels: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 3"]:
    """Points at depth 1 behind pixels."""
    return np.concatenate([(pixels - K[:2, 2]) / np.diag(K)[:2], np.ones((len(pixels), 1))], axis=-1)


def epipolar_distances(
    rays_a: Float64[np.ndarray, "n 3"],
    rays_b: Float64[np.ndarray, "m 3"],
    R: Float64[np.ndarray, "3 3"],
    t: Float64[np.ndarray, "3"],
) -> Float64[np.ndarray, "n m"]:
    """Distance of each ray of camera b from the epipolar line of each ray of camera a, in the plane z = 1 of b.

    `R`, `t` take camera a's coordinates to camera b's; rays have z = 1.
    """
    lines = np.cross(t, rays_a @ R.T)
    return np.abs(lines @ rays_b.T) / np.maximum(np.linalg.norm(lines[:, :2], axis=-1), 1e-300)[:, None]


def match(
    descriptors_a: Bool[np.ndarray, "n bits"],
    descriptors_b: Bool[np.ndarray, "m bits"],
    allowed: Bool[np.ndarray, "n m"],
) -> tuple[Int[np.ndarray, " p"], Int[np.ndarray, " p"]]:
    """Rows of `descriptors_a` and of `descriptors_b` that are each other's nearest among the `allowed` pairs.

    Kept are those within `MAX_HAMMING` bits and clearly nearer than the second best. With the poses known the epipolar
    lines leave a handful of candidates each, which brings up to twice the matches of a search everywhere, fewer wrong.
    """
    bits = descriptors_a.shape[1]
    if min(allowed.shape) < 2:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    a, b = (2.0 * d.astype(np.float32) - 1.0 for d in (descriptors_a, descriptors_b))
    hamming = np.where(allowed, (bits - a @ b.T) / 2, bits)
    rows, nearest = np.arange(len(a)), hamming.argmin(axis=1)
    best, second = np.partition(hamming, 1, axis=1)[:, :2].T
    keep = (hamming.argmin(axis=0)[nearest] == rows) & (best <= MAX_HAMMING) & (best < MAX_RATIO * second)
    return rows[keep], nearest[keep]


def triangulate(
    rays_a: Float64[np.ndarray, "n 3"],
    rays_b: Float64[np.ndarray, "n 3"],
    R: Float64[np.ndarray, "3 3"],
    t: Float64[np.ndarray, "3"],
) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Inverse depths in camera a where two rays pass closest, and the angle between the rays in degrees.

    `R`, `t` take camera a's coordinates to camera b's; rays have z = 1, so lengths along them are depths.

    Limits:
        Parallel rays give 0: infinitely far. Rays that meet behind camera a give a negative inverse depth and angle.
    """
    along = rays_a @ R.T
    bb, ab = (rays_b * rays_b).sum(-1), (along * rays_b).sum(-1)
    # depth = ahead / sine2; near infinity both vanish, sine2 faster.
    ahead = ab * (rays_b @ t) - bb * (along @ t)
    sine2 = (np.cross(along, rays_b) ** 2).sum(-1)
    inverse_depths = np.where(ahead == 0, 0.0, sine2 / np.where(ahead == 0, 1.0, ahead))
    return inverse_depths, np.copysign(np.degrees(np.arctan2(np.sqrt(sine2), ab)), inverse_depths)
