"""Depth range of a capture, estimated from sparse matches between nearby frames.

    ORB keypoints -> mutual matches near the epipolar lines -> inverse depths and parallax -> quantiles

The estimate takes some seconds per capture.

Depths are kept as *signed inverse* depths up to the last step: with little parallax, the error of a point is symmetric
in inverse depth and may move it past infinity. Dropping such points, or those with little parallax, would bias the
median towards the camera (by 30 % at a median parallax of 1 degree); the median of all signed values has no such bias.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Float64

from ssplat_jax.config import MEDIAN_DEPTH, StreamConfig
from ssplat_jax.core.numerics import evenly_spread
from ssplat_jax.data.sparse_matches import (
    MIN_POINTS,
    CommonPoints,
    KeypointsOf,
    PosedImages,
    keypoints_of,
    triangulate_pair,
)

# Choice of pairs
NUM_REFERENCES = 16  # evenly spaced frames for which a partner is sought
NUM_DETECTORS = 2  # threads that find keypoints, which takes most of the time; Python's lock leaves more no gain
MAX_AXIS_DEGREES = 40.0  # between the optical axes of a pair; ORB does not match larger changes of view
GOOD_PARALLAX_DEGREES = 4.0  # median parallax at which a reference needs no wider partner
POOR_PARALLAX_DEGREES = 0.5  # pairs with less give a rough median, and no depth range
POSE_ROUNDING = 1e-12  # relative to the distance from the origin (at least 1); closer cameras have the same place
# Choice of points
MIN_TOTAL_POINTS = 30  # with fewer, depths are guessed from baselines
FAR_PARALLAX_DEGREES = 1.5  # points with less are too uncertain to bound the depth of the scene
MIN_FAR_PARALLAX_SHARE = 0.9  # if fewer of all points than this have that parallax, or ...
MIN_PAIRS = 12  # ... there are fewer pairs than this, backgrounds may have been missed, and ...
MIN_REACH = 2.3  # ... the 99 % quantile is taken to be at least this many medians
PARALLAX_ERROR = 0.15  # degrees, of a triangulated point: most of a pixel of the working images
BEYOND_FAR_SHARE = 0.1  # share of the image that may certainly lie beyond far; for a larger background far is moved
CLOSE_SHARE = 0.15  # smallest share of a nearest partner's points with sufficient parallax; false matches are fewer
CLOSE_QUANTILE = 0.9  # of the inverse depths of a nearest partner's points; false matches lie above it
# Guesses
GUESSED_SPREAD = 4.0  # median over the 1 % quantile, and 99 % quantile over the median, where they are not measured
BASELINE_DEPTH = 5.0  # median depth over the median step between frames, where nothing matches
# Factors that widen the quantiles to the depth range
NEAR_FACTOR = 0.55  # near over the 1 % quantile; the nearest surfaces may have no keypoints
FAR_FACTOR = 1.8  # far over the 99 % quantile, for the same reason
MIN_RANGE, MAX_RANGE = 4.0, 60.0  # far / near
MIN_NEAR = 1 / 8  # of the median; too wide a range is first cut up to this at the near end, then at the far end

WARNINGS = {  # by the source of the depths
    "baselines": "Hardly any matches between frames: depth, near, far and scale are guessed from the steps between"
    " cameras; check poses and axes, or set the scene scale.",
    "poor parallax": "Low parallax: near and far are guessed around the median depth; take frames farther apart"
    " (--stride).",
}


@dataclasses.dataclass(frozen=True)
class DepthStatistics:
    """Quantiles of the depths of sparse points, in capture units."""

    q01: float
    median: float
    q99: float
    num_points: int
    parallax_degrees: float  # median over the points; 0 if there are none
    source: str  # "matches" (measured), "poor parallax" (only the median is measured) or "baselines" (a guess)

    @property
    def warning(self) -> str | None:
        """Message for the user about a failed measurement, or None."""
        return WARNINGS.get(self.source)


def estimate_depths(
    capture: PosedImages,
    indices: Sequence[int],
    advance: Callable[[int], None] = lambda done: None,
    keypoints: KeypointsOf | None = None,
) -> DepthStatistics:
    """Estimates the quantiles of depth in the frames `indices`.

    `advance` is called with the number of references, of at most `NUM_REFERENCES`, that are done.

    Limits:
        With a median parallax below 0.5 degrees only the median is measured, and the range is 4 times to both sides.
        Without matches (one frame, a pure rotation, bare walls) the median is 5 median steps between frames, or 1 if
        the camera does not move.
    """
    keypoints = keypoints or keypoints_of(capture)
    references = evenly_spread(len(indices), NUM_REFERENCES)
    sought = [indices[k] for k in references]
    sought += [j for i in sought for j in _partners(capture, i, indices)[0][:1]]
    with ThreadPoolExecutor(NUM_DETECTORS) as pool:
        list(pool.map(keypoints, dict.fromkeys(sought)))
    pairs: list[CommonPoints] = []
    baseline = 0.0
    for done, reference in enumerate(references):
        advance(done)
        points = _best_pair(capture, indices[reference], indices, baseline, keypoints)
        if points is not None:
            pairs.append(points)
            baseline = math.radians(GOOD_PARALLAX_DEGREES) / max(_median(pairs), 1e-300)
    good = [p for p in pairs if np.median(p.parallax) >= POOR_PARALLAX_DEGREES]
    if sum(p.parallax.size for p in good) >= MIN_TOTAL_POINTS and _median(good) > 0:
        return _statistics(good)
    if sum(p.parallax.size for p in pairs) >= MIN_TOTAL_POINTS and (inverse_depth := _median(pairs)) > 0:
        return _guess(1 / inverse_depth, "poor parallax", pairs)
    steps = np.linalg.norm(np.diff(np.stack([capture.frames[i].center for i in indices]), axis=0), axis=-1)
    steps = steps[steps > same_place_distance(capture, indices)]
    return _guess(BASELINE_DEPTH * float(np.median(steps)) if steps.size else 1.0, "baselines", [])


def same_place_distance(capture: PosedImages, indices: Sequence[int]) -> float:
    """The largest distance at which cameras count as being in the same place, since poses are rounded.

    It follows from the median camera of the frames `indices`: one diverged camera must not make all other
    places count as one.
    """
    reaches = [float(np.abs(capture.frames[i].center).max()) for i in indices]
    return POSE_ROUNDING * max(1.0, float(np.median(reaches)))


def stream_scale(depths: DepthStatistics, config: StreamConfig) -> tuple[float, float, float]:
    """(scale, near, far): stream units per capture unit, and the depth range in stream units.

    far / near is kept in [4, 60]. Too narrow a range is widened to both sides; too wide a range is cut at the near end
    up to an eighth of the median, and then at the far end.
    """
    scale = MEDIAN_DEPTH / depths.median if config.stream.scene_scale == "auto" else float(config.stream.scene_scale)
    near, far = NEAR_FACTOR * depths.q01, FAR_FACTOR * depths.q99
    widen = max(1.0, math.sqrt(MIN_RANGE * near / far))
    near, far = near / widen, far * widen
    near = max(near, min(far / MAX_RANGE, MIN_NEAR * depths.median))
    return scale, scale * near, scale * min(far, near * MAX_RANGE)


def _statistics(pairs: list[CommonPoints]) -> DepthStatistics:
    """Quantiles of the points of pairs with sufficient parallax."""
    inverse = np.concatenate([p.inverse_depths for p in pairs])
    parallax = np.concatenate([p.parallax for p in pairs])
    close = np.concatenate([p.close for p in pairs])
    nearest = max(np.quantile(inverse, 0.99), np.quantile(close, CLOSE_QUANTILE) if close.size else 0.0)
    middle = _median(pairs)
    reached = inverse[parallax >= FAR_PARALLAX_DEGREES]
    reach = 1 / np.quantile(reached, 0.01) if reached.size else 0.0
    if reached.size < MIN_FAR_PARALLAX_SHARE * inverse.size or len(pairs) < MIN_PAIRS:
        reach = max(reach, MIN_REACH / middle)
    least = _least_inverse_depth(pairs)
    # A background without parallax, surely beyond the points that have some, must lie before far: otherwise the matcher
    # puts confident floaters in between.
    if least < 1 / (FAR_FACTOR * reach):
        farthest = MAX_RANGE * NEAR_FACTOR / (FAR_FACTOR * nearest)
        reach = max(reach, min(1 / least, farthest))
    quantiles = float(1 / nearest), float(1 / middle), float(reach)
    return DepthStatistics(*quantiles, inverse.size, float(np.median(parallax)), "matches")


def _guess(median: float, source: str, pairs: list[CommonPoints]) -> DepthStatistics:
    """Quantiles at a fixed ratio to a median, where the range is not measured."""
    parallax = np.concatenate([p.parallax for p in pairs]) if pairs else np.zeros(1)
    num_points = sum(p.parallax.size for p in pairs)
    quantiles = median / GUESSED_SPREAD, median, median * GUESSED_SPREAD
    return DepthStatistics(*quantiles, num_points, float(np.median(parallax)), source)


def _best_pair(
    capture: PosedImages, i: int, others: Sequence[int], baseline: float, keypoints: KeypointsOf
) -> CommonPoints | None:
    """Common points of frame `i` and its nearest partner with sufficient parallax, or None.

    `baseline` is a guess at the distance of that partner. Partners farther away are tried first, until the parallax
    suffices or matching fails; if none of them matches, nearer partners are tried.
    """
    partners, distances = _partners(capture, i, others)
    count = len(partners)
    ladder = sorted({min(2**k, count) - 1 for k in range(count.bit_length() + 1)}) if count else []
    start = next((k for k, rank in enumerate(ladder) if distances[rank] >= baseline), max(len(ladder) - 1, 0))
    best = None
    for rank in ladder[start:]:
        points = triangulate_pair(capture, i, partners[rank], keypoints)
        best = best if points is None else points
        if points is None or np.median(points.parallax) >= GOOD_PARALLAX_DEGREES:
            break
    for rank in reversed(ladder[:start]):
        best = triangulate_pair(capture, i, partners[rank], keypoints) if best is None else best
    if best is None:
        return None
    # Close surfaces leave the view first: over a wide baseline only the background would match and determine near.
    nearest = triangulate_pair(capture, i, partners[0], keypoints)
    if nearest is None:
        return best
    close = nearest.inverse_depths[nearest.parallax >= FAR_PARALLAX_DEGREES]
    is_enough = close.size >= max(MIN_POINTS, CLOSE_SHARE * nearest.parallax.size)
    return dataclasses.replace(best, close=close) if is_enough else best


def _partners(capture: PosedImages, i: int, others: Sequence[int]) -> tuple[list[int], Float64[np.ndarray, " n"]]:
    """Frames with about the same viewing direction as frame `i` but another place, nearest first, and their distances.

    Partners are near in space and not in time, because a set of photos has no order and a path may return.
    """
    frame = capture.frames[i]
    offsets = np.stack([capture.frames[j].center for j in others]) - frame.center
    axes = np.stack([capture.frames[j].camtoworld[:3, 2] for j in others])
    distances = np.linalg.norm(offsets, axis=-1)
    is_aligned = axes @ frame.camtoworld[:3, 2] > math.cos(math.radians(MAX_AXIS_DEGREES))
    is_partner = is_aligned & (distances > same_place_distance(capture, [i, *others]))
    order = [int(k) for k in np.argsort(distances, kind="stable") if is_partner[k]]
    return [others[k] for k in order], distances[order]


def _median(pairs: list[CommonPoints]) -> float:
    """Median inverse depth by image area, since keypoints crowd on surfaces with many corners."""
    return _quantile_by_area(pairs, [p.inverse_depths for p in pairs], 0.5)


def _quantile_by_area(pairs: list[CommonPoints], values: list[Float64[np.ndarray, " _"]], share: float) -> float:
    """Weighted quantile: the value below which a `share` of the image area lies."""
    flat, weights = np.concatenate(values), np.concatenate([p.weights for p in pairs])
    order = np.argsort(flat)
    cumulative = np.cumsum(weights[order])
    return float(flat[order][np.searchsorted(cumulative, share * cumulative[-1])])


def _least_inverse_depth(pairs: list[CommonPoints]) -> float:
    """Upper bound of the inverse depths of the farthest `BEYOND_FAR_SHARE` of the image, including their errors.

    Points that lie behind the camera even with their error are false matches and are ignored.
    """
    bounds = []
    for p in pairs:
        # Errors are large near the direction of motion, where parallax is small.
        moved = p.parallax != 0
        per_degree = np.abs(p.inverse_depths / np.where(moved, p.parallax, 1.0))
        bound = p.inverse_depths + np.where(moved, PARALLAX_ERROR * per_degree, np.inf)
        bounds.append(np.where(bound > 0, bound, np.inf))
    return _quantile_by_area(pairs, bounds, BEYOND_FAR_SHARE)
