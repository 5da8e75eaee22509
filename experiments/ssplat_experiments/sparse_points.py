"""Sparse points of posed views, and the Gaussians that per-scene optimization starts from.

    keypoints of the views -> matches near the epipolar lines -> triangulated points, or random ones in the frustums

Per-scene optimization as published starts from the points of structure from motion. Captures come with poses, so the
points are triangulated here, from the views that are learned from alone.
"""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.sparse_matches import (
    MAX_EPIPOLAR_PX,
    epipolar_distances,
    keypoints_of,
    match,
    pixel_rays,
    triangulate,
)
from ssplat_jax.data.stream_frame import StreamFrame

NUM_PARTNERS = 6
"""Views whose keypoints are matched with those of a view: the nearest ones that look about the same way."""

MIN_PARALLAX_DEGREES = 1.5
"""Points with less are too uncertain along the ray."""

MIN_TRIANGULATED = 300
"""With fewer points, random ones are used."""

NUM_RANDOM = 10_000
START_OPACITY = 0.1
"""Opacity of all Gaussians at the start, as published."""

Points = tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]
"""Places in the stream frame and colors in [0, 1]."""


def sparse_points(capture: Capture, indices: Sequence[int], frame: StreamFrame) -> tuple[Points, str]:
    """Points of the views `indices` and their origin: `triangulated`, or `random` where too few are found.

    Args:
        capture: the views.
        indices: frames that may be looked at.
        frame: frame of the points; its near and far bound random ones.
    """
    points = triangulated_points(capture, indices, frame)
    if len(points[0]) >= MIN_TRIANGULATED:
        return points, "triangulated"
    return random_points(capture, indices, frame, NUM_RANDOM), "random"


def triangulated_points(capture: Capture, indices: Sequence[int], frame: StreamFrame) -> Points:
    """Common points of each view and its `NUM_PARTNERS` nearest ones, with the color of the view."""
    keypoints, places, colors = keypoints_of(capture), [np.zeros((0, 3))], [np.zeros((0, 3))]
    for i in indices:
        a = capture.frames[i].camtoworld
        for j in _partners(capture, i, indices):
            b = capture.frames[j].camtoworld
            R, t = b[:3, :3].T @ a[:3, :3], b[:3, :3].T @ (a[:3, 3] - b[:3, 3])  # camera i -> camera j
            ka, kb = keypoints(i), keypoints(j)
            rays_a, rays_b = pixel_rays(capture.K(i), ka.pixels), pixel_rays(capture.K(j), kb.pixels)
            near_line = epipolar_distances(rays_a, rays_b, R, t) < MAX_EPIPOLAR_PX * kb.pixel / capture.K(j)[0, 0]
            of_a, of_b = match(ka.descriptors, kb.descriptors, near_line)
            inverse_depths, parallax = triangulate(rays_a[of_a], rays_b[of_b], R, t)
            good = parallax >= MIN_PARALLAX_DEGREES
            points = rays_a[of_a][good] / inverse_depths[good][:, None]
            places.append(_in_frame(points @ a[:3, :3].T + a[:3, 3], frame))
            colors.append(_colors_at(capture.image(i), ka.pixels[of_a][good]))
    return np.concatenate(places), np.concatenate(colors)


def random_points(capture: Capture, indices: Sequence[int], frame: StreamFrame, count: int) -> Points:
    """Points on random rays of the views, their inverse depths uniform between those of near and far."""
    rng = np.random.default_rng(0)
    shares = [len(part) for part in np.array_split(np.arange(count), len(indices))]
    places, colors = [], []
    for i, share in zip(indices, shares, strict=True):
        pixels = rng.uniform((0, 0), (capture.width, capture.height), (share, 2))
        depths = 1 / rng.uniform(1 / frame.far, 1 / frame.near, share) / frame.scale  # of the capture
        pose = capture.frames[i].camtoworld
        points = pixel_rays(capture.K(i), pixels) * depths[:, None]
        places.append(_in_frame(points @ pose[:3, :3].T + pose[:3, 3], frame))
        colors.append(_colors_at(capture.image(i), pixels))
    return np.concatenate(places), np.concatenate(colors)


def _partners(capture: Capture, i: int, indices: Sequence[int]) -> list[int]:
    """The nearest views in another place whose viewing direction differs by less than 45 degrees."""
    pose = capture.frames[i].camtoworld
    others = [j for j in indices if j != i and pose[:3, 2] @ capture.frames[j].camtoworld[:3, 2] > np.sqrt(0.5)]
    return sorted(others, key=lambda j: float(np.linalg.norm(capture.frames[j].center - pose[:3, 3])))[:NUM_PARTNERS]


def _in_frame(points: Float[np.ndarray, "n 3"], frame: StreamFrame) -> Float[np.ndarray, "n 3"]:
    return frame.scale * (points - frame.origin) @ frame.rotation


def _colors_at(image: Float[np.ndarray, "h w 3"], pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    columns, rows = np.floor(pixels).astype(int).T
    return image[np.clip(rows, 0, len(image) - 1), np.clip(columns, 0, image.shape[1] - 1)].astype(np.float64)


def gaussians_of_points(points: Points) -> Gaussians:
    """Round Gaussians as large as the distance to the three nearest points (root mean square), as published."""
    places, colors = points
    distances = np.asarray(KDTree(places).query(places, k=min(4, len(places)))[0]).reshape(len(places), -1)[:, 1:]
    sizes = np.sqrt(np.maximum(np.mean(distances**2, axis=1), 1e-7))
    count = len(places)
    return Gaussians.from_rgb(
        means=jnp.asarray(places, jnp.float32),
        quats=jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0]), (count, 1)),
        scales=jnp.asarray(np.repeat(sizes[:, None], 3, axis=1), jnp.float32),
        opacities=jnp.full(count, START_OPACITY),
        colors=jnp.asarray(colors, jnp.float32),
    )
