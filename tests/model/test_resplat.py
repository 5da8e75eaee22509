"""ReSplat's network: its sizes, and its layers against plain definitions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.config import preset
from ssplat_jax.model.hpda import expected_log_depth
from ssplat_jax.model.resplat.encoder import POSITIONS_SIDE, resampled_positions
from ssplat_jax.model.resplat.torch_layers import resize
from ssplat_jax.model.views import prepare_views, to_candidate_space
from ssplat_jax.training.losses import soft_targets
from tests.model.small import chunk

CONFIG = preset("small").replace(mixer_blocks=1, num_depths=32, min_confidence=0.0, capacity=1 << 11, chunk_size=3)


def test_resize_keeps_corners_and_interpolates_linearly():
    x = np.random.default_rng(0).normal(size=(2, 5, 7, 3)).astype(np.float32)
    for height, width in ((5, 7), (9, 13), (3, 4), (16, 11), (1, 1)):
        rows, columns = np.linspace(0, 4, height), np.linspace(0, 6, width)
        wanted = np.empty((2, height, width, 3))
        for v, c in np.ndindex(2, 3):
            between = np.array([np.interp(columns, np.arange(7), row) for row in x[v, :, :, c]])
            wanted[v, :, :, c] = np.array([np.interp(rows, np.arange(5), column) for column in between.T]).T
        np.testing.assert_allclose(resize(jnp.asarray(x), height, width), wanted, atol=1e-5)


def test_position_codes_are_resampled_as_by_dinov2():
    codes = jnp.asarray(np.random.default_rng(0).normal(size=(1, 1 + POSITIONS_SIDE**2, 2)), jnp.float32)
    np.testing.assert_array_equal(resampled_positions(codes, 37, 37), codes[:, 1:])
    np.testing.assert_allclose(resampled_positions(jnp.ones_like(codes), 9, 50), 1.0, atol=1e-5)
    # Keys' cubic convolution with a = -0.75 (JAX has -0.5), at positions for a factor of (size + 0.1) / 37.
    rows, columns = 9, 50
    wanted = np.zeros((rows, columns, 2))
    grid = np.asarray(codes[0, 1:], np.float64).reshape(37, 37, 2)
    for i, j in np.ndindex(rows, columns):
        y, x = (i + 0.5) * 37 / (rows + 0.1) - 0.5, (j + 0.5) * 37 / (columns + 0.1) - 0.5
        for v, u in np.ndindex(4, 4):
            row, column = int(np.floor(y)) + v - 1, int(np.floor(x)) + u - 1
            weight = keys_kernel(y - row) * keys_kernel(x - column)
            wanted[i, j] += weight * grid[np.clip(row, 0, 36), np.clip(column, 0, 36)]
    np.testing.assert_allclose(resampled_positions(codes, rows, columns), wanted.reshape(1, -1, 2), atol=1e-5)


def keys_kernel(t: float, a: float = -0.75) -> float:
    t = abs(t)
    if t <= 1:
        return (a + 2) * t**3 - (a + 3) * t**2 + 1
    return a * (t**3 - 5 * t**2 + 8 * t - 4) if t < 2 else 0.0


def test_depths_are_averaged_in_the_space_of_candidates():
    given = chunk(height=40, width=56)
    for space, average in (("log", np.sqrt(2.0 * 8.0)), ("inverse", 2 / (1 / 2.0 + 1 / 8.0))):
        config = CONFIG.replace(depth_space=space, depth_range=(2.0, 8.0))
        candidates = jax.jit(prepare_views, static_argnums=1)(given, config).log_candidates
        apart = np.diff(np.asarray(to_candidate_space(candidates, config), np.float64))
        np.testing.assert_allclose(apart, apart[0], rtol=1e-3)
        np.testing.assert_allclose(np.exp(sorted(np.asarray(candidates)[[0, -1]])), [2.0, 8.0], rtol=1e-6)
        both_ends = jnp.asarray(np.where(np.arange(32) % 31 == 0, 0.5, 0.0), jnp.float32)
        depth = jax.jit(expected_log_depth, static_argnums=2)(both_ends, candidates, config)
        assert np.exp(depth) == pytest.approx(average, rel=1e-5)
        # Targets peak at the candidates next to the true depth, whatever their distance.
        for truth in np.log([2.05, 3.0, 5.0, 7.8]):
            targets = np.asarray(jax.jit(soft_targets, static_argnums=2)(jnp.float32(truth), candidates, 0.6))
            assert targets.sum() == pytest.approx(1.0, abs=1e-5)
            nearest = np.argsort(np.abs(np.asarray(candidates) - truth))[:2]
            assert np.argmax(targets) in nearest and targets[nearest].sum() > 0.6
