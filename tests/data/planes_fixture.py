"""Captures in memory of two textured planes, whose depth is known."""

import functools

import numpy as np
from skimage.filters import gaussian
from skimage.transform import resize

from ssplat_jax.data.capture import ArrayPixels, Capture
from ssplat_jax.data.posed_image import Frame

HEIGHT, WIDTH, FOCAL = 120, 160, 140.0
NEAR_PLANE, FAR_PLANE = 2.0, 4.0


def texture(rng):
    """Color texture of 512x512 texels with corners at several scales."""
    noise = [resize(rng.random((n, n, 3)), (512, 512), order=0) for n in (32, 64, 128)]
    return gaussian(sum(noise) / 3, 1.0, channel_axis=-1).astype(np.float32)


@functools.cache
def textures(number, seed):
    rng = np.random.default_rng(seed)
    return [texture(rng) for _ in range(number)]


def on_plane(depth, colors, center, rays):
    """Colors, depths and points at which rays from a camera's center meet a textured plane."""
    along = (depth - center[2]) / rays[..., 2]
    hit = center + along[..., None] * rays
    texel = np.floor((hit[..., :2] / (4 * depth) + 0.5) * 512).astype(int) % 512  # about one per pixel
    return colors[texel[..., 1], texel[..., 0]], along, hit


def two_planes(
    num_frames, step, *, forward=0.0, units=1.0, spin=0.0, seed=0, start=0.0, wall_at=FAR_PLANE, board_half=0.4
):
    """Capture of a camera that moves by `step` sideways and `forward` ahead, and turns by `spin` degrees, a frame.

    It sees a textured wall at depth `wall_at`, and before it a board at depth 2 of half side `board_half`.
    """
    wall, board = textures(2, seed)
    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    directions = np.stack([(columns - WIDTH / 2) / FOCAL, (rows - HEIGHT / 2) / FOCAL, np.ones_like(rows)], -1)
    images, depths, frames = [], [], []
    for i in range(num_frames):
        c, s = np.cos(np.radians(spin * i)), np.sin(np.radians(spin * i))
        pose = np.array([[c, 0, s, start + step * i], [0, 1, 0, 0], [-s, 0, c, forward * i], [0, 0, 0, 1.0]])
        rays = directions @ pose[:3, :3].T
        far_image, far, _ = on_plane(wall_at, wall, pose[:3, 3], rays)
        near_image, near, hit = on_plane(NEAR_PLANE, board, pose[:3, 3], rays)
        on_board = (np.abs(hit[..., :2]) < board_half).all(-1)
        images.append(np.where(on_board[..., None], near_image, far_image))
        depths.append(np.where(on_board, near, far) * units)
        pose[:3, 3] *= units
        K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
        frames.append(Frame(name=str(i), camtoworld=pose, K=K, width=WIDTH, height=HEIGHT))
    pixels = ArrayPixels(images=np.stack(images).astype(np.float32), depths=np.stack(depths).astype(np.float32))
    return Capture(name="planes", format="memory", frames=tuple(frames), pixels=pixels, width=WIDTH, height=HEIGHT)
