"""A smooth way from camera to camera, for films."""

import numpy as np
from jaxtyping import Float64


def camera_path(
    camtoworlds: Float64[np.ndarray, "n 4 4"], Ks: Float64[np.ndarray, "n 3 3"], steps: int
) -> tuple[Float64[np.ndarray, "m 4 4"], Float64[np.ndarray, "m 3 3"]]:
    """The cameras and, between each and the next, `steps - 1` others: m = (n - 1) steps + 1.

    Centers and the entries of rotations follow Catmull and Rom's spline, which passes through all that it is given;
    each matrix is then replaced by the nearest rotation. Intrinsics change in proportion.

    Limits:
        Rotations from one camera to the next of up to 120 degrees: between cameras that look in opposite directions
        no way is nearer than another, and the one taken may jump.
    """
    n = len(camtoworlds)
    if n < 2:
        return camtoworlds, Ks
    places = np.arange((n - 1) * steps + 1) / steps
    before = np.minimum(places.astype(int), n - 2)
    t = (places - before)[:, None, None]
    first, last = 2 * camtoworlds[0] - camtoworlds[1], 2 * camtoworlds[-1] - camtoworlds[-2]  # beyond the ends
    points = np.concatenate([first[None], camtoworlds, last[None]])
    a, b, c, d = (points[before + i] for i in range(4))
    path = b + 0.5 * t * (c - a + t * (2 * a - 5 * b + 4 * c - d + t * (3 * (b - c) + d - a)))
    u, _, vt = np.linalg.svd(path[:, :3, :3])
    u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
    path[:, :3, :3] = u @ vt
    return path, (1 - t) * Ks[before] + t * Ks[before + 1]
