"""A smooth path through given cameras, for films, and what is up for them."""

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
    # Control points before the first and after the last camera are extrapolated.
    first, last = 2 * camtoworlds[:1] - camtoworlds[1:2], 2 * camtoworlds[-1:] - camtoworlds[-2:-1]
    points = np.concatenate([first, camtoworlds, last])
    a, b, c, d = (points[before + i] for i in range(4))
    path = b + 0.5 * t * (c - a + t * (2 * a - 5 * b + 4 * c - d + t * (3 * (b - c) + d - a)))
    u, _, vt = np.linalg.svd(path[:, :3, :3])
    u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
    path[:, :3, :3] = u @ vt
    return path, (1 - t) * Ks[before] + t * Ks[before + 1]


def upward(camtoworlds: Float64[np.ndarray, "n 4 4"]) -> Float64[np.ndarray, "3"] | None:
    """The up direction of cameras that are held level: perpendicular to their images' rows, by least squares.

    Rows of images that lie on their side point up or down, and do not count. Where rows do not tell, because all are
    parallel, it is the mean of the images' up directions; None if that is 0.
    """
    mean = -camtoworlds[:, :3, 1].mean(axis=0)
    if np.linalg.norm(mean) < 0.1:
        return None
    mean /= np.linalg.norm(mean)
    rows = camtoworlds[:, :3, 0]
    rows = rows[np.abs(rows @ mean) < np.sqrt(0.5)]
    shares, axes = np.linalg.eigh(np.einsum("ni,nj->ij", rows, rows))
    axis = axes[:, 0] if shares[1] > 1e-2 * len(camtoworlds) else mean
    return axis if axis @ mean > 0 else -axis
