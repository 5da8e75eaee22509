"""Windows of a feature map, for attention inside them (Swin; ALGORITHM 2.3)."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float


def sine_positions(height: int, width: int, features: int) -> Float[np.ndarray, "h w c"]:
    """Sine position code of a window: half of the channels for y, half for x (DETR's, normalized to 2 pi)."""
    half = features // 2
    rates = 10000.0 ** (2 * (np.arange(half) // 2) / half)

    def along(n):
        phases = (np.arange(n) + 1)[:, None] / n * 2 * np.pi / rates
        return np.where(np.arange(half) % 2 == 0, np.sin(phases), np.cos(phases)).astype(np.float32)

    shape = (height, width, half)
    rows, columns = along(height)[:, None], along(width)[None, :]
    return np.concatenate([np.broadcast_to(rows, shape), np.broadcast_to(columns, shape)], axis=-1)


def to_windows(x: Float[Array, "v h w c"], side: tuple[int, int]) -> Float[Array, "v windows cells c"]:
    """Cuts a map into windows of `side` cells, (height, width)."""
    v, h, w, c = x.shape
    x = x.reshape(v, h // side[0], side[0], w // side[1], side[1], c).transpose(0, 1, 3, 2, 4, 5)
    return x.reshape(v, (h // side[0]) * (w // side[1]), side[0] * side[1], c)


def from_windows(
    x: Float[Array, "v windows cells c"], side: tuple[int, int], height: int, width: int
) -> Float[Array, "v h w c"]:
    """Inverse of `to_windows`."""
    v, c = x.shape[0], x.shape[-1]
    x = x.reshape(v, height // side[0], width // side[1], *side, c).transpose(0, 1, 3, 2, 4, 5)
    return x.reshape(v, height, width, c)


def in_one_region(
    height: int, width: int, side: tuple[int, int], shift: tuple[int, int]
) -> Bool[Array, "1 windows cells cells"]:
    """Which cells of the windows of a map rolled by `-shift` are neighbors, not opposite borders in one window."""
    rows, columns = (np.arange(n) >= n - s for n, s in zip((height, width), shift, strict=True))
    regions = jnp.asarray((2 * rows[:, None] + columns)[None, :, :, None], jnp.float32)
    cells = to_windows(regions, side)[..., 0]
    return cells[..., :, None] == cells[..., None, :]
