"""Pictures of the inside of a box with textured walls, in NumPy: cheap, and with parallax in every direction."""

import functools

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from tests.data.planes_fixture import texture

WIDTH, HEIGHT, FOCAL = 160, 120, 128.0
HALF = 2.0  # side of the box
K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])


def walk(num_frames, step=0.09):
    """Camera-to-world poses on a bent path that turns and tilts."""
    poses = np.tile(np.eye(4), (num_frames, 1, 1))
    for i in range(num_frames):
        s = step * i
        poses[i, :3, :3] = Rotation.from_euler("yx", [0.4 * s, 0.15 * np.sin(3 * s)]).as_matrix()
        poses[i, :3, 3] = [s - 0.6, 0.25 * np.sin(2.5 * s), -1.0 + 0.4 * s * s]
    return poses


@functools.cache
def walls():
    return np.stack([texture(np.random.default_rng([0, face])) for face in range(6)])


def pictures(poses):
    """Images (h, w, 3) of 8 bits; box corners and walls are seen from inside."""
    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([(columns - WIDTH / 2) / FOCAL, (rows - HEIGHT / 2) / FOCAL, np.ones_like(rows)], -1)
    return [_picture(walls(), rays @ pose[:3, :3].T, pose[:3, 3]) for pose in poses]


def _picture(walls, directions, center):
    with np.errstate(divide="ignore"):
        along = (np.sign(directions) * HALF - center) / directions
    axis = along.argmin(-1)
    hit = center + along.min(-1)[..., None] * directions
    face = 2 * axis + (np.take_along_axis(directions, axis[..., None], -1)[..., 0] > 0)
    uv = np.where((axis == 0)[..., None], hit[..., 1:], np.where((axis == 1)[..., None], hit[..., ::2], hit[..., :2]))
    texel = (uv / HALF + 1) / 2 * 300
    image = np.zeros((HEIGHT, WIDTH, 3))
    for k in range(6):
        seen = face == k
        for c in range(3):
            at = [texel[seen][:, 1], texel[seen][:, 0]]
            image[seen, c] = map_coordinates(walls[k, ..., c], at, order=1, mode="nearest")
    return (image * 255 + 0.5).clip(0, 255).astype(np.uint8)
