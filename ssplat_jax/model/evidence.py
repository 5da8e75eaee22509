"""Evidence head: opacity, scale and contrast of a pivot's Gaussians from how views saw it (an addition to Sec. 3.6).

The decoder reads a pivot's feature, which was computed when its token was written. Later views tell more: how many of
them saw the pivot, how well its color fitted there, and how many other pivots share its place. A small MLP reads these
numbers and changes opacity, scales and the differences between the colors of a pivot's Gaussians. Before training it
changes nothing.
"""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from ssplat_jax.cache.observations import observation_features
from ssplat_jax.cache.state import NUM_OBSERVED
from ssplat_jax.config import StreamConfig
from ssplat_jax.core.numerics import safe_log, safe_sqrt
from ssplat_jax.core.pytree import pytree, replace
from ssplat_jax.model.types import TokenShapes

MAX_LOGIT_CHANGE = 4.0
"""Bound of what is added to an opacity's logit."""
MAX_LOG_CONTRAST = 1.0
"""Bound of the log factor on the differences between the colors of a pivot's Gaussians."""

WIDTH = 32
"""Channels of the hidden layers."""


@pytree
class Evidence:
    """Facts about `m` pivots in the cache, besides their features."""

    observations: Float[Array, "m s"]
    confidences: Float[Array, " m"]
    num_members: Float[Array, " m"]
    num_pivots: Float[Array, " m"]  # in the same voxel
    footprints: Float[Array, " m"]  # stream units
    growth: Float[Array, " m"]  # footprint that is decoded over the stored one
    rgbs: Float[Array, "m a"]


class EvidenceHead(nn.Module):
    """Maps evidence to changes of the opacity's logit, the log scales and the log contrast.

    Scales change sideways and along the view. Before training all changes are 0.
    """

    @nn.compact
    def __call__(self, x: Float[Array, "m f"]) -> Float[Array, "m 4"]:
        x = nn.gelu(nn.Dense(WIDTH, name="hidden1")(x))
        x = nn.gelu(nn.Dense(WIDTH, name="hidden2")(x))
        return nn.Dense(4, kernel_init=nn.initializers.zeros, name="out")(x)


def num_features() -> int:
    """Number of inputs of the evidence head."""
    one = jnp.ones(1)
    evidence = Evidence(jnp.zeros((1, NUM_OBSERVED)), one, one, one, one, one, jnp.zeros((1, 3)))
    return evidence_features(evidence, StreamConfig()).shape[1]


def evidence_features(evidence: Evidence, config: StreamConfig) -> Float[Array, "m f"]:
    """Evidence as numbers of about unit size.

    Limits:
        Confidences of 0 and 1, zero observations and zero footprints, as dead pivots have them, and equal colors give
        finite features with finite gradients.
    """
    omega = jnp.clip(evidence.confidences, 1e-3, 0.96)
    colors = evidence.rgbs.reshape(len(evidence.rgbs), -1, 3)
    features = (
        safe_log(omega) - jnp.log1p(-omega) - 2.0,
        safe_log(jnp.maximum(evidence.num_members, 1.0)),
        safe_log(jnp.maximum(evidence.footprints, 1e-6) / config.memory.voxel_size),
        evidence.num_pivots - 2.5,
        safe_log(jnp.maximum(evidence.growth, 1.0)),
        10 * safe_sqrt(jnp.var(colors, axis=1)).mean(axis=-1) - 0.5,
        2 * colors.mean(axis=(1, 2)) - 1.0,
    )
    return jnp.concatenate([jnp.stack(features, axis=-1), observation_features(evidence.observations)], axis=-1)


def apply_evidence(
    params, shapes: TokenShapes, evidence: Evidence, config: StreamConfig
) -> tuple[TokenShapes, Float[Array, "m a"]]:
    """Shapes and colors of pivots, changed as the evidence asks for.

    A rendered surface is a mixture of Gaussians that overlap and of layers that do not lie exactly on each other, which
    blurs it. So the colors of a pivot's Gaussians may be moved away from their mean, more where the evidence is good.

    Args:
        params: parameters of `EvidenceHead`.
        shapes: what the decoder's own head predicts.
        evidence: facts about the pivots, their colors among them.
        config: model configuration.

    Returns:
        The shapes with other opacities and scales, and the colors, whose mean over a pivot stays as it is.

    Limits:
        Logits change by at most `MAX_LOGIT_CHANGE`, differences of colors by a factor of at most
        exp(`MAX_LOG_CONTRAST`); the decoder bounds the scales. Colors may leave [0, 1].
    """
    out = EvidenceHead().apply({"params": params}, evidence_features(evidence, config))
    logit, sideways, along, contrast = jnp.moveaxis(jnp.asarray(out), -1, 0)
    change = MAX_LOGIT_CHANGE * jnp.tanh(logit / MAX_LOGIT_CHANGE)
    shapes = replace(
        shapes,
        logit_opacities=shapes.logit_opacities + change,
        raw_scales=shapes.raw_scales + jnp.stack([sideways, sideways, along], axis=-1),
    )
    return shapes, _with_contrast(evidence.rgbs, MAX_LOG_CONTRAST * jnp.tanh(contrast / MAX_LOG_CONTRAST))


def _with_contrast(rgbs: Float[Array, "m a"], log_gains: Float[Array, " m"]) -> Float[Array, "m a"]:
    """Colors whose differences from their mean over the pivot are multiplied by exp(`log_gains`); 0 changes no bit."""
    colors = rgbs.reshape(len(rgbs), -1, 3)
    differences = colors - colors.mean(axis=1, keepdims=True)
    return rgbs + (jnp.expm1(log_gains)[:, None, None] * differences).reshape(rgbs.shape)
