"""Camera paths for films: smooth ones through given cameras, and around what they look at."""

import numpy as np
from jaxtyping import Float64

SWAY_RADIUS = 0.08  # of a sway, as a share of the distance looked at
MIN_SHARE = 0.01  # smallest distance of a camera from the point that all look at, over the distance of what it sees


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


def looked_at(camtoworlds: Float64[np.ndarray, "n 4 4"], distance: float) -> Float64[np.ndarray, "3"] | None:
    """The point nearest to the optical axes of all cameras, by least squares.

    None if the axes are parallel to about a degree, if the point lies behind a camera, or if it lies at a camera's own
    place, as it does if all turn about one place. `distance` is that of what the cameras see, in units of the poses.
    """
    centers, axes = camtoworlds[:, :3, 3], camtoworlds[:, :3, 2]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]  # distance from an axis
    total = across.sum(axis=0)
    if np.linalg.eigvalsh(total)[0] < 3e-4 * len(axes):
        return None
    point = np.linalg.solve(total, np.einsum("nij,nj->i", across, centers))
    return point if (np.einsum("ni,ni->n", point - centers, axes) > MIN_SHARE * distance).all() else None


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


def orbit_path(
    camtoworlds: Float64[np.ndarray, "n 4 4"], K: Float64[np.ndarray, "3 3"], distance: float, num_cameras: int
) -> tuple[Float64[np.ndarray, "m 4 4"], Float64[np.ndarray, "m 3 3"]]:
    """A closed path around what cameras look at: m = `num_cameras` cameras that look at one point.

    Around a common point (`looked_at`) it is a circle about the cameras' up axis (`upward`), at their mean distance
    from it and their mean height. Cameras that look outward have no such point, and from outside a room shows its walls
    only: the path is then a sway, a small circle about the middle camera, which looks at a point straight ahead at the
    `distance` of what the cameras see, in units of the poses.
    """
    middle = camtoworlds[len(camtoworlds) // 2]
    turns = 2 * np.pi * np.arange(num_cameras) / num_cameras
    target, up = looked_at(camtoworlds, distance), upward(camtoworlds)
    if target is None or up is None:
        target, up = middle[:3, 3] + distance * middle[:3, 2], -middle[:3, 1]
        circle = np.cos(turns)[:, None] * middle[:3, 0] + np.sin(turns)[:, None] * middle[:3, 1]
        centers = middle[:3, 3] + SWAY_RADIUS * distance * circle
    else:
        arms = camtoworlds[:, :3, 3] - target
        heights = arms @ up
        flat = arms - heights[:, None] * up
        lengths = np.linalg.norm(flat, axis=1)
        first = np.argmax(lengths > 0.5 * lengths.max())  # one that is not on the axis
        start = flat[first] / lengths[first]
        circle = np.cos(turns)[:, None] * start + np.sin(turns)[:, None] * np.cross(up, start)
        centers = target + lengths.mean() * circle + heights.mean() * up
    path = np.stack([look_at(center, target, up) for center in centers])
    return path, np.repeat(K[None], num_cameras, axis=0)


def look_at(
    center: Float64[np.ndarray, "3"], target: Float64[np.ndarray, "3"], up: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "4 4"]:
    """The pose of a camera at `center` that looks at `target`, with `up` upward in its image.

    Limits:
        A camera that looks along `up` has no upward direction: its rotation then has NaN.
    """
    forward = (target - center) / np.linalg.norm(target - center)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(forward, right), forward, center], axis=1)
    return pose
