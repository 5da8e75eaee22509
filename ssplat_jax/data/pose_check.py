"""Test of poses and focal lengths against the images: epipolar consistency of matches that were found without poses.

    keypoints -> mutual matches, poses unused -> share consistent with the poses in each convention
                                              -> share consistent with longer and shorter focal lengths

A match is consistent if it lies near its epipolar line and its point in front of the camera. Poses in a wrong
convention (camera axes, direction of the matrix) leave a small share of the matches consistent; in the right one most
are. So do focal lengths of another crop or size, within half the distance: a wrong one moves lines by a few pixels.
Poses that fit in no convention, though the matches agree on some motion, belong to other images or are wrong.
"""

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float64
from skimage.measure import ransac
from skimage.transform import FundamentalMatrixTransform

from ssplat_jax.data.posed_image import CONVENTIONS, Convention, Frame
from ssplat_jax.data.sparse_matches import (
    MAX_EPIPOLAR_PX,
    KeypointsOf,
    PosedImages,
    match,
    motion_between,
    pixel_rays,
    triangulate,
)

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
    num_matches: int


def matched_pairs(capture: PosedImages, indices: Sequence[int], keypoints: KeypointsOf) -> Iterator[MatchedPair]:
    """Yields pairs of frames with matches that move, references evenly spread over `indices`."""
    references = np.unique(np.linspace(0, len(indices) - 2, NUM_PAIRS).round().astype(int)) if len(indices) > 1 else []
    for reference in references:
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
    return PoseFit(shares=shares, focal_shares=focal_shares, coherent_share=coherent / total, num_matches=total)


def _num_consistent(
    pair: MatchedPair,
    a: Float64[np.ndarray, "4 4"],
    b: Float64[np.ndarray, "4 4"],
    factors: tuple[float, float] = (1.0, 1.0),
    tolerance: float = 1.0,
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
    _, inliers = ransac(pair.pixels, FundamentalMatrixTransform, **options)
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
        return (
            f"Images and focal lengths disagree: {as_given:.0%} of the matches are consistent, and {better:.0%} would"
            f" be with about {times}; check that the intrinsics are those of these images, as cropped or resized."
        )
    if given < POOR_SHARE * fit.coherent_share and fit.coherent_share >= GOOD_SHARE:
        return (
            f"Poses do not fit the images: {given:.0%} of the matches are consistent with them, and"
            f" {fit.coherent_share:.0%} with some motion; check that each pose belongs to its image, and intrinsics."
        )
    return None
