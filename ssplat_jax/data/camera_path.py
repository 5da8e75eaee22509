"""Smooth camera path through given cameras, for videos."""

import numpy as np
from jaxtyping import Float64


def camera_path(
    camtoworlds: Float64[np.ndarray, "n 4 4"], Ks: Float64[np.ndarray, "n 3 3"], steps: int
) -> tuple[Float64[np.ndarray, "m 4 4"], Float64[np.ndarray, "m 3 3"]]:
    """Inserts `steps - 1` cameras between each pair of consecutive cameras: m = (n - 1) steps + 1.

    Centers and rotation matrices follow a Catmull-Rom spline, which passes through all given cameras; each interpolated
    matrix is then replaced by the nearest rotation. Intrinsics are interpolated linearly.

    Limits:
        Consecutive cameras may differ by rotations of up to 120 degrees. Between cameras that look in opposite
        directions the shortest rotation is ambiguous, and the path may jump.
    """
    n = len(camtoworlds)
    if n < 2:
        return camtoworlds, Ks
    places = np.arange((n - 1) * steps + 1) / steps
    before = np.minimum(places.astype(int), n - 2)
    t = (places - before)[:, None, None]
    first, last = (
        2 * camtoworlds[0] - camtoworlds[1],
        2 * camtoworlds[-1] - camtoworlds[-2],
    )  # extrapolated control points before the first and after the last camera
    points = np.concatenate([first[None], camtoworlds, last[None]])
    a, b, c, d = (points[before + i] for i in range(4))
    path = b + 0.5 * t * (c - a + t * (2 * a - 5 * b + 4 * c - d + t * (3 * (b - c) + d - a)))
    u, _, vt = np.linalg.svd(path[:, :3, :3])
    u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
    path[:, :3, :3] = u @ vt
    return path, (1 - t) * Ks[before] + t * Ks[before + 1]
