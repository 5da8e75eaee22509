"""Hole filling against scikit-image, the range of its colors and its gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.filters import gaussian

from ssplat_jax.rasterizer import fill_holes

BACKGROUND = np.array([0.1, 0.5, 0.9])


def image(seed: int, height: int = 17, width: int = 23):
    """Premultiplied colors and alphas, half of them 0 or 1."""
    rng = np.random.default_rng(seed)
    alpha = np.clip(rng.uniform(-0.5, 1.5, (height, width)), 0.0, 1.0)
    return rng.uniform(0.2, 0.8, (height, width, 3)) * alpha[..., None], alpha


def oracle(color, alpha, sigma):
    blur = lambda x: gaussian(x, sigma, mode="constant", truncate=3.0)  # noqa: E731
    above = np.stack([blur(color[..., k] + 1e-3 * BACKGROUND[k]) for k in range(3)], axis=-1)
    return color + (1 - alpha)[..., None] * above / blur(alpha + 1e-3)[..., None]


@pytest.mark.parametrize("sigma", [2.0, 4.0])
def test_a_batch_equals_scikit_image(sigma):
    colors, alphas = (np.stack(x) for x in zip(image(0), image(1), strict=True))
    alphas[1] = 1.0  # opaque: the color stays
    filled = fill_holes(jnp.asarray(colors), jnp.asarray(alphas), jnp.asarray(BACKGROUND), sigma=sigma)
    wanted = [oracle(color, alpha, sigma) for color, alpha in zip(colors, alphas, strict=True)]
    np.testing.assert_allclose(filled, wanted, atol=2e-6)
    np.testing.assert_array_equal(filled[1], np.float32(colors[1]))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**20))
def test_filled_colors_stay_in_the_range_of_those_around(seed):
    color, alpha = image(seed)
    filled = np.asarray(fill_holes(jnp.asarray(color), jnp.asarray(alpha), jnp.asarray(BACKGROUND)))
    assert filled.min() >= min(0.2, BACKGROUND.min()) - 1e-5 and filled.max() <= max(0.8, BACKGROUND.max()) + 1e-5


def test_gradients_are_finite_at_the_limits():
    slopes = jax.jit(jax.grad(lambda *x: (fill_holes(*x) ** 2).sum(), argnums=(0, 1, 2)))
    for opacity in (0.0, 1e-30, 0.5, 1.0):
        given = jnp.full((9, 9, 3), 0.5 * opacity), jnp.full((9, 9), opacity), jnp.asarray(BACKGROUND)
        assert all(np.isfinite(g).all() for g in slopes(*given))
