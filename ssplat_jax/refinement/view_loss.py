"""The error of a key view, on the pixels that are learned from and on those that are held back."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ssplat_jax.cache.key_views import KeyViews
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.rasterizer import Effects, fill_holes, render
from ssplat_jax.refinement.refine_config import RefineConfig

EFFECTS = Effects(outputs=("color", "alpha"))
BLOCK = 8
"""Side of the pixel blocks that are held back together: neighbors of a pixel give its color away."""


def held_back_pixels(size: tuple[int, int], view: Int[Array, ""], config: RefineConfig) -> Bool[Array, "h w"]:
    """Pixels of a view that no gradient sees: the same blocks at every step.

    Args:
        size: height and width of the image.
        view: slot of the view.
        config: gives the fraction and the seed.
    """
    height, width = size
    key = jax.random.fold_in(jax.random.key(config.seed + 1), view)
    blocks = jax.random.uniform(key, (-(-height // BLOCK), -(-width // BLOCK))) < config.held_back
    return jnp.repeat(jnp.repeat(blocks, BLOCK, axis=0), BLOCK, axis=1)[:height, :width]


def view_loss(
    gaussians: Gaussians,
    background: Float[Array, "3"],
    key_views: KeyViews,
    view: Int[Array, ""],
    config: RefineConfig,
    max_pairs: int,
) -> tuple[Float[Array, ""], tuple[Float[Array, ""], Float[Array, ""], Int[Array, ""]]]:
    """L1 error of one key view at its exposure, with holes filled by `background` and over black.

    Args:
        gaussians: the scene.
        background: color that fills holes, at the exposure of the scene.
        key_views: the views to compare with.
        view: slot of the view.
        config: weights of both errors, and which pixels are held back.
        max_pairs: capacity for tile intersections.

    Returns:
        The loss, and the loss again, the error of the held-back pixels, and the tile intersections that did not fit.
    """
    height, width = key_views.images.shape[1:3]
    held_back = held_back_pixels((height, width), view, config)
    out = render(gaussians, key_views.camera(view), effects=EFFECTS, max_pairs=max_pairs)
    filled = fill_holes(out.color, out.alpha, background)
    target = key_views.images[view].astype(jnp.float32) / 255
    exposure = key_views.exposures[view]
    errors = config.shown_weight * jnp.abs(filled * exposure - target)
    errors = errors + (1 - config.shown_weight) * jnp.abs(out.color * exposure - target)
    errors = jnp.mean(errors, axis=-1)
    loss = mean_over(errors, ~held_back)
    return loss, (loss, mean_over(errors, held_back), out.num_overflow)


def mean_over(errors: Float[Array, "h w"], pixels: Bool[Array, "h w"]) -> Float[Array, ""]:
    """Mean error of some pixels; 0 for none."""
    return jnp.sum(jnp.where(pixels, errors, 0.0)) / jnp.maximum(jnp.sum(pixels, dtype=errors.dtype), 1.0)
