"""Losses: rendering (Eq. training_loss), and depth, which procedural scenes provide (ours)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ssplat_jax.evaluation.lpips import LpipsWeights, lpips
from ssplat_jax.training.recipe import Recipe

MIN_STEP = 1e-6
"""Smallest step of log depth between candidates that is divided by; steps are 0 where near = far."""


def soft_targets(
    log_depths: Float[Array, "*b"], log_candidates: Float[Array, " d"], width: float
) -> Float[Array, "*b d"]:
    """Target distribution over the candidates: a normalized Gaussian around the true depth.

    Args:
        log_depths: natural logarithms of the true depths.
        log_candidates: natural logarithms of the candidates.
        width: standard deviation in steps between candidates.

    Limits:
        A single candidate has probability 1; candidates at one depth have equal probabilities.
    """
    # Candidates may be uniform in inverse depth: each has its own step of log depth.
    steps = jnp.abs(jnp.asarray(jnp.gradient(log_candidates))) if len(log_candidates) > 1 else jnp.zeros(1)
    step = jnp.maximum(steps, MIN_STEP)
    return jax.nn.softmax(-0.5 * ((log_candidates - log_depths[..., None]) / (width * step)) ** 2, axis=-1)


def depth_loss(
    logits: Float[Array, "v hf wf d"],
    predicted: Float[Array, "v hf wf"],
    truth: Float[Array, "v hf wf"],
    log_candidates: Float[Array, " d"],
    usable: Bool[Array, "v hf wf"],
    *,
    target_width: float,
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Cross entropy of P_i and L1 of the anchored log depth: means over usable cells with a true depth in range.

    Args:
        logits: of P_i.
        predicted: anchored log depths.
        truth: true log depths.
        log_candidates: natural logarithms of the candidates, which give the range.
        usable: cells that count.
        target_width: see `soft_targets`.

    Returns:
        The cross entropy and the L1.

    Limits:
        A true depth that is infinite (-inf is the logarithm of an unknown 0) or NaN is out of range and contributes
        nothing to value and gradient.
    """
    in_range = usable & (truth > log_candidates.min()) & (truth < log_candidates.max())
    truth = jnp.where(in_range, truth, jax.lax.stop_gradient(predicted))
    weight = in_range.astype(jnp.float32) / jnp.maximum(in_range.sum(), 1).astype(jnp.float32)
    targets = soft_targets(truth, log_candidates, target_width)
    entropy = -jnp.sum(targets * jax.nn.log_softmax(logits, axis=-1), axis=-1)
    return jnp.sum(weight * entropy), jnp.sum(weight * jnp.abs(predicted - truth))


def image_gradient_l1(a: Float[Array, "s h w 3"], b: Float[Array, "s h w 3"]) -> Float[Array, ""]:
    """L1 distance of the horizontal and vertical pixel differences of two images."""
    difference = a - b
    horizontal = jnp.abs(difference[:, :, 1:] - difference[:, :, :-1]).mean()
    vertical = jnp.abs(difference[:, 1:] - difference[:, :-1]).mean()
    return horizontal + vertical


MAX_GAIN = 2.0
"""Largest gain between a scene and a photograph that training divides out; its reciprocal is the smallest."""


class RenderingLoss(NamedTuple):
    """Loss of rendered views, and its parts."""

    total: Float[Array, ""]
    mse: Float[Array, ""]
    lpips: Float[Array, ""] | None  # None without LPIPS weights


def rendering_loss(
    images: Float[Array, "s h w 3"],
    targets: Float[Array, "s h w 3"],
    recipe: Recipe,
    lpips_weights: LpipsWeights | None = None,
) -> RenderingLoss:
    """MSE and LPIPS (Eq. training_loss), or MSE and the L1 of image gradients without LPIPS weights.

    The mean over the views, or with `recipe.sum_views` their sum; the parts are means in either case.

    Args:
        images: rendered views, RGB.
        targets: true views, RGB in [0, 1].
        recipe: gives the weights of the terms.
        lpips_weights: weights of LPIPS, if there are any.
    """
    num_views = len(images) if recipe.sum_views else 1
    mse = jnp.mean((images - targets) ** 2)
    if lpips_weights is None:
        total = mse + recipe.gradient_weight * image_gradient_l1(images, targets)
        return RenderingLoss(num_views * total, mse, None)
    distance = lpips(lpips_weights, images, targets).mean()
    return RenderingLoss(num_views * (mse + recipe.lpips_weight * distance), mse, distance)


def fitted_gains(images: Float[Array, "s h w 3"], targets: Float[Array, "s h w 3"]) -> Float[Array, "s 1 1 3"]:
    """Gain per view and channel with which an image is nearest to its target; not differentiated.

    Photographs have exposures of their own, which a scene of one exposure cannot show and should not learn to.

    Limits:
        Gains stay in [1 / MAX_GAIN, MAX_GAIN]; of a black image the gain is 1.
    """
    images, targets = jax.lax.stop_gradient((images, targets))
    energy = jnp.sum(images * images, axis=(1, 2), keepdims=True)
    gains = jnp.sum(images * targets, axis=(1, 2), keepdims=True) / jnp.where(energy > 0, energy, 1.0)
    return jnp.where(energy > 0, jnp.clip(gains, 1 / MAX_GAIN, MAX_GAIN), 1.0)
