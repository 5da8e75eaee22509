"""Losses: rendering (Eq. training_loss) and, since procedural scenes know it, depth."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


def soft_targets(
    log_depths: Float[Array, "*b"], log_candidates: Float[Array, " d"], width: float = 0.6
) -> Float[Array, "*b d"]:
    """True depth as a narrow distribution over the candidates: a Gaussian of `width` bins, normalised."""
    step = (log_candidates[-1] - log_candidates[0]) / (log_candidates.shape[0] - 1)
    return jax.nn.softmax(-0.5 * ((log_candidates - log_depths[..., None]) / (width * step)) ** 2, axis=-1)


def depth_loss(
    logits: Float[Array, "v hf wf d"],
    predicted: Float[Array, "v hf wf"],
    truth: Float[Array, "v hf wf"],
    log_candidates: Float[Array, " d"],
    usable: Bool[Array, "v hf wf"],
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Cross entropy of P_i and L1 of the anchored log depth, each a mean over usable cells with a depth in range."""
    in_range = usable & (truth > log_candidates[0]) & (truth < log_candidates[-1])
    weight = in_range.astype(jnp.float32) / jnp.maximum(in_range.sum(), 1).astype(jnp.float32)
    targets = soft_targets(truth, log_candidates)
    entropy = -jnp.sum(targets * jax.nn.log_softmax(logits, axis=-1), axis=-1)
    return jnp.sum(weight * entropy), jnp.sum(weight * jnp.abs(predicted - truth))


def image_gradient_l1(a: Float[Array, "s h w 3"], b: Float[Array, "s h w 3"]) -> Float[Array, ""]:
    """Mean absolute difference of the horizontal and vertical pixel differences of two images."""
    difference = a - b
    horizontal = jnp.abs(difference[:, :, 1:] - difference[:, :, :-1]).mean()
    vertical = jnp.abs(difference[:, 1:] - difference[:, :-1]).mean()
    return horizontal + vertical
