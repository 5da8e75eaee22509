"""Changes to the Gaussians of a scene: their units, their bounds, and the scene that they lead to."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.core.numerics import clip_value
from ssplat_jax.core.pytree import pytree, replace
from ssplat_jax.refinement.refine_config import RefineConfig

MAX_LOGIT = 12.0
"""Bound of opacity logits and of their changes: beyond it a float32 opacity is 0 or 1 and its gradient is lost."""


@pytree
class Revision:
    """Changes to `n` Gaussians, all zero at the start. Also the form of gradients and moments."""

    means: Float[Array, "n 3"]  # in units of the Gaussian's own size
    quats: Float[Array, "n 4"]  # added to the unit quaternion
    log_scales: Float[Array, "n 3"]
    logit_opacities: Float[Array, " n"]
    sh: Float[Array, "n k 3"]


def no_revision(gaussians: Gaussians) -> Revision:
    """The revision of `gaussians` that changes nothing."""
    return Revision(
        means=jnp.zeros_like(gaussians.means),
        quats=jnp.zeros_like(gaussians.quats),
        log_scales=jnp.zeros_like(gaussians.scales),
        logit_opacities=jnp.zeros_like(gaussians.opacities),
        sh=jnp.zeros_like(gaussians.sh),
    )


def apply_revision(start: Gaussians, revision: Revision) -> Gaussians:
    """`start` moved by `revision`, differentiable in both.

    Limits:
        An opacity of 0 stays 0 with a zero gradient; one of 1 counts as the largest below it. No other gradient of an
        opacity is 0.
    """
    is_present = start.opacities > 0
    opacities = jnp.clip(jnp.where(is_present, start.opacities, 0.5), 1e-5, 1 - 1e-5)
    logits = jnp.log(opacities) - jnp.log1p(-opacities) + revision.logit_opacities
    logits = clip_value(logits, -MAX_LOGIT, MAX_LOGIT)
    return Gaussians(
        means=start.means + sizes(start)[:, None] * revision.means,
        quats=_unit(start.quats) + revision.quats,
        scales=start.scales * jnp.exp(revision.log_scales),
        opacities=jnp.where(is_present, jax.nn.sigmoid(logits), 0.0),
        sh=start.sh + revision.sh,
    )


def is_revised(revision: Revision):
    """Mask of the rows that a revision changes."""
    parts = [jnp.any(jnp.reshape(x != 0, (x.shape[0], -1)), axis=1) for x in jax.tree.leaves(revision)]
    return jnp.stack(parts).any(axis=0)


def sizes(gaussians: Gaussians) -> Float[Array, " n"]:
    """Mean of the two larger standard deviations: the extent of a flat Gaussian in its plane."""
    smallest = jnp.min(gaussians.scales, axis=-1)
    return (jnp.sum(gaussians.scales, axis=-1) - smallest) / 2


def _unit(quats: Float[Array, "n 4"]) -> Float[Array, "n 4"]:
    length = jnp.linalg.norm(quats, axis=-1, keepdims=True)
    return quats / jnp.where(length > 0, length, 1.0)


def bounded(revision: Revision, config: RefineConfig) -> Revision:
    """`revision` inside its trust region."""
    distance = jnp.linalg.norm(revision.means, axis=-1, keepdims=True)
    shrink = jnp.minimum(1.0, config.max_shift / jnp.maximum(distance, 1e-12))
    limit = config.max_log_scale_change
    return replace(
        revision,
        means=revision.means * shrink,
        log_scales=jnp.clip(revision.log_scales, -limit, limit),
        logit_opacities=jnp.clip(revision.logit_opacities, -MAX_LOGIT, MAX_LOGIT),
    )
