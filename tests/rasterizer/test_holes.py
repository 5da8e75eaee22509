"""Hole filling against scikit-image, its limits and its gradients."""

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
def test_equals_scikit_image(sigma):
    color, alpha = image(0)
    filled = fill_holes(jnp.asarray(color), jnp.asarray(alpha), jnp.asarray(BACKGROUND), sigma=sigma)
    np.testing.assert_allclose(filled, oracle(color, alpha, sigma), atol=2e-6)


def test_batches_are_images_one_by_one():
    images = [image(seed) for seed in range(3)]
    colors, alphas = (jnp.asarray(np.stack(x)) for x in zip(*images, strict=True))
    together = fill_holes(colors, alphas, jnp.asarray(BACKGROUND))
    separate = [fill_holes(c, a, jnp.asarray(BACKGROUND)) for c, a in zip(colors, alphas, strict=True)]
    np.testing.assert_allclose(together, jnp.stack(separate), atol=1e-6)


def test_opaque_images_stay_and_empty_ones_are_background():
    color, _ = image(1)
    covered = fill_holes(jnp.asarray(color), jnp.ones(color.shape[:2]), jnp.asarray(BACKGROUND))
    np.testing.assert_array_equal(covered, np.float32(color))
    empty = fill_holes(jnp.zeros_like(covered), jnp.zeros(color.shape[:2]), jnp.asarray(BACKGROUND))
    np.testing.assert_allclose(empty, np.broadcast_to(BACKGROUND, color.shape), rtol=1e-5)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**20))
def test_filled_colors_stay_in_the_range_of_those_around(seed):
    color, alpha = image(seed)
    filled = np.asarray(fill_holes(jnp.asarray(color), jnp.asarray(alpha), jnp.asarray(BACKGROUND)))
    assert filled.min() >= min(0.2, BACKGROUND.min()) - 1e-5 and filled.max() <= max(0.8, BACKGROUND.max()) + 1e-5


def test_a_translucent_surface_of_one_color_shows_that_color():
    alpha = image(2)[1] * 0.5 + 0.3
    color = np.array([0.7, 0.2, 0.4])
    filled = fill_holes(jnp.asarray(alpha[..., None] * color), jnp.asarray(alpha), jnp.asarray(BACKGROUND))
    np.testing.assert_allclose(filled, np.broadcast_to(color, filled.shape), atol=2e-3)


@pytest.mark.parametrize("opacity", [0.0, 1e-30, 0.5, 1.0])
def test_gradients_are_finite_at_the_limits(opacity):
    color, alpha = jnp.full((9, 9, 3), 0.5 * opacity), jnp.full((9, 9), opacity)
    gradients = jax.grad(lambda *x: (fill_holes(*x) ** 2).sum(), argnums=(0, 1, 2))(
        color, alpha, jnp.asarray(BACKGROUND)
    )
    assert all(np.isfinite(g).all() for g in gradients)
