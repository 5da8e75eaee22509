"""Gradients of a tile's samples by the shape of their Gaussians, against sums in float64."""

import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.rasterizer.binning import Grid
from ssplat_jax.rasterizer.compositing import _shape_gradients
from ssplat_jax.rasterizer.render import TILES


def in_float64(grid: Grid, exponents: np.ndarray, values: np.ndarray) -> np.ndarray:
    """The six gradients, sample by sample: the exponent is (p dx + q dy)^2 + (r dy)^2 - log opacity."""
    side = np.arange(grid.tile) - (grid.tile - 1) / 2
    x, y, p, q, r, _ = values
    dx, dy = np.tile(side, grid.tile)[:, None, None] - x, np.repeat(side, grid.tile)[:, None, None] - y
    s = p * dx + q * dy
    slopes = [-2 * s * p, -2 * (s * q + r * r * dy), 2 * s * dx, 2 * s * dy, 2 * r * dy * dy, -np.ones_like(s)]
    return np.stack([np.sum(exponents * slope, axis=0) for slope in slopes])


@pytest.mark.parametrize("tile", TILES)
@pytest.mark.parametrize("shape", ["round", "needle across", "needle along", "far away"])
def test_shape_gradients_equal_sums_in_float64(tile, shape):
    """Samples are weighted by exp(-s^2 - (r dy)^2), as those of a render: only pixels that are drawn count."""
    random, size = np.random.default_rng(0), (8, 32)
    grid = Grid(num_images=1, height=tile, width=tile, tile=tile)
    sigmas, distance = {
        "round": ((0.4, 3.0), 6.0),
        "needle across": ((0.33, 300.0), 6.0),
        "needle along": ((0.33, 300.0), 200.0),
        "far away": ((40.0, 60.0), 80.0),
    }[shape]
    turns = random.uniform(0, np.pi, size)
    axes = np.stack([np.cos(turns), np.sin(turns)]), np.stack([-np.sin(turns), np.cos(turns)])
    xx, xy, yy = (
        sum(s**2 * a[i] * a[j] for s, a in zip(sigmas, axes, strict=True)) for i, j in ((0, 0), (0, 1), (1, 1))
    )
    r = np.sqrt(0.5 / yy)
    p = np.sqrt(0.5 * yy / (xx * yy - xy**2))
    q = -p * xy / yy
    along = random.uniform(-distance, distance, size)  # means on the long axis, which passes near the tile's center
    x, y = along * axes[1] + random.uniform(-2, 2, (2, *size))
    values = np.stack([x, y, p, q, r, np.zeros(size)]).astype(np.float32)
    side = np.arange(tile) - (tile - 1) / 2
    exact = values.astype(np.float64)
    dx, dy = np.tile(side, tile)[:, None, None] - exact[0], np.repeat(side, tile)[:, None, None] - exact[1]
    drawn = np.exp(-((exact[2] * dx + exact[3] * dy) ** 2) - (exact[4] * dy) ** 2)
    exponents = np.asarray(np.where(drawn > 1 / 255, drawn, 0) * random.normal(size=drawn.shape), np.float32)
    got = np.stack(_shape_gradients(grid, jnp.asarray(exponents), jnp.asarray(values)))
    wanted = in_float64(grid, exponents.astype(np.float64), exact)
    for column, (a, b) in enumerate(zip(got, wanted, strict=True)):
        assert np.abs(b).max() > 0
        assert np.linalg.norm(a - b) < 3e-5 * np.linalg.norm(b), column
