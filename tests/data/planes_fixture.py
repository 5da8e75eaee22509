"""Captures in memory of two textured planes, whose depth is known."""

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


def two_planes(
    num_frames, step, *, forward=0.0, units=1.0, spin=0.0, seed=0, start=0.0, wall_at=FAR_PLANE, board_half=0.4
):
    """Capture of a camera that moves by `step` sideways and `forward` ahead, and turns by `spin` degrees, a frame.

    It sees a textured wall at depth `wall_at`, and before it a board at depth 2 of half side `board_half`.
    """
    rng = np.random.default_rng(seed)
    wall, board = texture(rng), texture(rng)
    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([(columns - WIDTH / 2) / FOCAL, (rows - HEIGHT / 2) / FOCAL, np.ones_like(rows)], -1)
    images, depths, frames = [], [], []
    for i in range(num_frames):
        c, s = np.cos(np.radians(spin * i)), np.sin(np.radians(spin * i))
        pose = np.array([[c, 0, s, start + step * i], [0, 1, 0, 0], [-s, 0, c, forward * i], [0, 0, 0, 1.0]])
        world = rays @ pose[:3, :3].T
        image, depth = None, None
        for plane, colors in ((wall_at, wall), (NEAR_PLANE, board)):
            extent = 4 * plane  # about one texel per pixel
            along = (plane - pose[2, 3]) / world[..., 2]
            hit = pose[:3, 3] + along[..., None] * world
            texel = np.floor((hit[..., :2] / extent + 0.5) * 512).astype(int) % 512
            shade = colors[texel[..., 1], texel[..., 0]]
            if image is None:
                image, depth = shade, along
            else:
                on_board = (np.abs(hit[..., :2]) < board_half).all(-1)
                image, depth = np.where(on_board[..., None], shade, image), np.where(on_board, along, depth)
        images.append(image)
        depths.append(depth * units)
        pose[:3, 3] *= units
        K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
        frames.append(Frame(name=str(i), camtoworld=pose, K=K, width=WIDTH, height=HEIGHT))
    pixels = ArrayPixels(images=np.stack(images).astype(np.float32), depths=np.stack(depths).astype(np.float32))
    return Capture(name="planes", format="memory", frames=tuple(frames), pixels=pixels, width=WIDTH, height=HEIGHT)
