"""Windows of feature maps for windowed attention (Swin Transformer, Liu et al. 2021)."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float


def sine_positions(height: int, width: int, features: int) -> Float[np.ndarray, "h w c"]:
    """Sine position code of a window, normalized to 2 pi as in DETR: half of the channels for y, half for x."""
    half = features // 2
    rates = 10000.0 ** (2 * (np.arange(half) // 2) / half)

    def along(n):
        phases = (np.arange(n) + 1)[:, None] / n * 2 * np.pi / rates
        return np.where(np.arange(half) % 2 == 0, np.sin(phases), np.cos(phases)).astype(np.float32)

    shape = (height, width, half)
    rows, columns = along(height)[:, None], along(width)[None, :]
    return np.concatenate([np.broadcast_to(rows, shape), np.broadcast_to(columns, shape)], axis=-1)


def to_windows(x: Float[Array, "v h w c"], side: tuple[int, int]) -> Float[Array, "v windows cells c"]:
    """Map cut into windows of `side` = (height, width) cells."""
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


def same_region_mask(
    height: int, width: int, side: tuple[int, int], shift: tuple[int, int]
) -> Bool[Array, "1 windows cells cells"]:
    """Pairs of cells in one window that may attend to each other, in a map rolled by `-shift`.

    Rolling brings cells from opposite borders of the map into one window; such pairs are False.
    """
    rows, columns = (np.arange(n) >= n - s for n, s in zip((height, width), shift, strict=True))
    regions = jnp.asarray((2 * rows[:, None] + columns)[None, :, :, None], jnp.float32)
    cells = to_windows(regions, side)[..., 0]
    return cells[..., :, None] == cells[..., None, :]
