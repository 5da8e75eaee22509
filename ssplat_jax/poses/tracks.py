"""Tracks: places of one point in several posed images, from SIFT keypoints matched near their epipolar lines.

    keypoints of each image -> pairs of cameras that look alike -> matches -> tracks, the surest matches first

Reference: Lowe, Distinctive Image Features from Scale-Invariant Keypoints, IJCV 2004.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, Int
from skimage.feature import SIFT

from ssplat_jax.data.posed_image import invert_pose
from ssplat_jax.data.sparse_matches import (
    PosedImages,
    epipolar_distances,
    gray_image,
    motion_between,
    mutual_nearest,
    only_seen,
    pixel_rays,
)
from ssplat_jax.poses.bundle_adjustment import Observations

LONG_SIDE = 640
"""Longer side of the working image in pixels; larger images are reduced."""
MIN_SIDE = 16
"""Shortest side of a working image in pixels: SIFT needs some octaves."""
NUM_PARTNERS = 8
"""Cameras that each camera is matched with: those most like it."""
MAX_AXIS_DEGREES = 40.0
"""Largest angle between the optical axes of a pair."""
DEGREES_OF_DEPTH = 60.0
"""Angle between axes that makes cameras as unlike as a distance of one median depth does."""
MAX_EPIPOLAR_DEGREES = 1.6
"""Largest distance of a match from its epipolar line: poses may be wrong by that much."""
MAX_DISTANCE, MAX_RATIO = 0.7, 0.8
"""Largest distance between the descriptors of a match, whose length is 1, and its ratio to the second smallest."""
MIN_MATCHES = 10
"""Fewest matches of a pair; fewer are mostly false."""


@dataclasses.dataclass(frozen=True, eq=False)
class SiftKeypoints:
    """SIFT keypoints of an image."""

    pixels: Float64[np.ndarray, "n 2"]  # in the delivered image
    descriptors: Float32[np.ndarray, "n 128"]  # of length 1


def find_tracks(
    capture: PosedImages,
    indices: Sequence[int],
    depth: float,
    advance: Callable[[int], None] = lambda done: None,
) -> Observations:
    """Tracks through the frames `indices`, whose positions in `indices` are the numbers of the views.

    Cameras are in the first one's frame, with lengths in median depths: the world's origin may be far away, and its
    axes must not matter.

    Args:
        capture: the frames.
        indices: those to use.
        depth: median depth of the scene, in capture units.
        advance: called with the number of frames whose keypoints are found.
    """
    found = []
    for done, i in enumerate(indices):
        found.append(only_seen(sift_keypoints(capture.image(i)), capture.seen(i)))
        advance(done + 1)
    poses = np.stack([capture.frames[i].camtoworld for i in indices])
    matches = [_match(capture, indices, pair, found) for pair in alike_cameras(poses, depth)]
    views, keypoints, points = merged_tracks([len(k.pixels) for k in found], matches)
    viewmats = np.stack([invert_pose(pose) @ poses[0] for pose in poses])
    viewmats[:, :3, 3] /= depth
    pixels = np.concatenate([k.pixels for k in found])[keypoints]
    return Observations(viewmats, np.stack([capture.K(i) for i in indices]), views, points, pixels)


def sift_keypoints(image: Float32[np.ndarray, "h w 3"]) -> SiftKeypoints:
    """The SIFT keypoints of an image; there are none if it is tiny or has no structure."""
    height, width = image.shape[:2]
    nothing = SiftKeypoints(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    shrink = max(1.0, max(height, width) / LONG_SIDE)
    size = (round(width / shrink), round(height / shrink))
    if min(size) < MIN_SIDE:
        return nothing
    detector: Any = SIFT()
    try:
        detector.detect_and_extract(gray_image(image, size))
    except RuntimeError:  # skimage raises it for an image without keypoints
        return nothing
    pixels = (detector.keypoints[:, ::-1] + 0.5) * np.array([width / size[0], height / size[1]])
    descriptors = detector.descriptors.astype(np.float32)
    return SiftKeypoints(pixels, descriptors / np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), 1e-9))


def alike_cameras(camtoworlds: Float64[np.ndarray, "v 4 4"], depth: float) -> list[tuple[int, int]]:
    """Pairs of each camera with the `NUM_PARTNERS` that are most like it in place and direction.

    Args:
        camtoworlds: poses with OpenCV axes.
        depth: the distance that counts as much as `DEGREES_OF_DEPTH`, in the unit of the poses.
    """
    centers, axes = camtoworlds[:, :3, 3], camtoworlds[:, :3, 2]
    pairs = set()
    for i in range(len(camtoworlds)):
        angles = np.degrees(np.arccos(np.clip(axes @ axes[i], -1.0, 1.0)))
        unlike = np.linalg.norm(centers - centers[i], axis=1) / depth + angles / DEGREES_OF_DEPTH
        unlike[angles > MAX_AXIS_DEGREES], unlike[i] = np.inf, np.inf
        for j in np.argsort(unlike, kind="stable")[:NUM_PARTNERS]:
            if np.isfinite(unlike[j]):
                pairs.add((min(i, int(j)), max(i, int(j))))
    return sorted(pairs)


@dataclasses.dataclass(frozen=True, eq=False)
class Matches:
    """Matches of a pair of views."""

    views: tuple[int, int]
    keypoints: Int[np.ndarray, "n 2"]  # of the first and the second view
    distances: Float32[np.ndarray, " n"]  # between descriptors


def _match(
    capture: PosedImages, indices: Sequence[int], pair: tuple[int, int], found: Sequence[SiftKeypoints]
) -> Matches:
    """Matches near epipolar lines, which leave a few candidates each."""
    (i, j), (a, b) = (indices[v] for v in pair), (found[v] for v in pair)
    R, t = motion_between(capture.frames[i].camtoworld, capture.frames[j].camtoworld)
    lines = epipolar_distances(pixel_rays(capture.K(i), a.pixels), pixel_rays(capture.K(j), b.pixels), R, t)
    apart = np.sqrt(np.maximum(2 - 2 * a.descriptors @ b.descriptors.T, 0.0))
    apart = np.where(lines < np.radians(MAX_EPIPOLAR_DEGREES), apart, 2.0)
    rows, columns = mutual_nearest(apart, MAX_DISTANCE, MAX_RATIO)
    if len(rows) < MIN_MATCHES:
        rows, columns = rows[:0], columns[:0]
    return Matches(pair, np.stack([rows, columns], axis=1), apart[rows, columns])


def merged_tracks(
    counts: Sequence[int], matches: Sequence[Matches]
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """Tracks of the matches. The surest match comes first; one that would show a camera a point twice is left out.

    Args:
        counts: keypoints of each view.
        matches: matches of pairs of views.

    Returns:
        Of each observation the view, the keypoint (counted through all views), and the point; all numbers of points
        from 0 on occur, each at least twice.
    """
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    ends = [np.zeros((0, 2), np.int64), *(match.keypoints + starts[list(match.views)] for match in matches)]
    order = np.argsort(np.concatenate([np.zeros(0), *(match.distances for match in matches)]), kind="stable")
    view = np.repeat(np.arange(len(counts)), counts)
    track, members, seen_by = list(range(len(view))), [[i] for i in range(len(view))], [{v} for v in view.tolist()]
    for a, b in np.concatenate(ends)[order].tolist():
        a, b = track[a], track[b]
        if a == b or not seen_by[a].isdisjoint(seen_by[b]):
            continue
        if len(members[a]) < len(members[b]):
            a, b = b, a
        for i in members[b]:
            track[i] = a
        members[a] += members[b]
        seen_by[a] |= seen_by[b]
    numbers = np.array(track, np.int64)
    used = np.flatnonzero(np.bincount(numbers, minlength=len(numbers))[numbers] > 1)
    _, points = np.unique(numbers[used], return_inverse=True)
    return view[used], used, points
