"""Evidence head: opacity and scale of a pivot's Gaussians from how views saw the pivot (an addition to Sec. 3.6).

The decoder reads a pivot's feature, which was computed when its token was written. Later views tell more: how many of
them saw the pivot, how well its color fitted there, and how many other pivots share its place. A small MLP reads these
numbers and changes opacity and scales. Before training it changes nothing.
"""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from ssplat_jax.cache.sightings import features_of_sightings
from ssplat_jax.cache.state import NUM_SIGHTINGS
from ssplat_jax.config import StreamConfig
from ssplat_jax.model.types import TokenShapes
from ssplat_jax.numerics import safe_log
from ssplat_jax.pytree import pytree, replace

MAX_LOGIT_CHANGE = 4.0
"""Bound of what is added to an opacity's logit."""

WIDTH = 32
"""Channels of the hidden layers."""


@pytree
class Evidence:
    """Facts about `m` pivots in the cache, besides their features."""

    sightings: Float[Array, "m s"]
    confidences: Float[Array, " m"]
    num_members: Float[Array, " m"]
    num_pivots: Float[Array, " m"]  # in the same voxel
    footprints: Float[Array, " m"]  # stream units
    growth: Float[Array, " m"]  # footprint that is decoded over the stored one
    rgbs: Float[Array, "m a"]


class EvidenceHead(nn.Module):
    """Maps evidence to changes of the opacity's logit and of the log scales, sideways and along the view.

    Before training all changes are 0.
    """

    @nn.compact
    def __call__(self, x: Float[Array, "m f"]) -> Float[Array, "m 3"]:
        x = nn.gelu(nn.Dense(WIDTH, name="hidden1")(x))
        x = nn.gelu(nn.Dense(WIDTH, name="hidden2")(x))
        return nn.Dense(3, kernel_init=nn.initializers.zeros, name="out")(x)


def num_features() -> int:
    """Number of inputs of the evidence head."""
    one = jnp.ones(1)
    evidence = Evidence(jnp.zeros((1, NUM_SIGHTINGS)), one, one, one, one, one, jnp.zeros((1, 3)))
    return evidence_features(evidence, StreamConfig()).shape[1]


def evidence_features(evidence: Evidence, config: StreamConfig) -> Float[Array, "m f"]:
    """Evidence as numbers of about unit size.

    Limits:
        Confidences of 0 and 1, zero sightings and zero footprints, as dead pivots have them, give finite features.
    """
    omega = jnp.clip(evidence.confidences, 1e-3, 0.96)
    colors = evidence.rgbs.reshape(len(evidence.rgbs), -1, 3)
    features = (
        safe_log(omega) - jnp.log1p(-omega) - 2.0,
        safe_log(jnp.maximum(evidence.num_members, 1.0)),
        safe_log(jnp.maximum(evidence.footprints, 1e-6) / config.memory.voxel_size),
        evidence.num_pivots - 2.5,
        safe_log(jnp.maximum(evidence.growth, 1.0)),
        10 * jnp.std(colors, axis=1).mean(axis=-1) - 0.5,
        2 * colors.mean(axis=(1, 2)) - 1.0,
    )
    return jnp.concatenate([jnp.stack(features, axis=-1), features_of_sightings(evidence.sightings)], axis=-1)


def apply_evidence(params, shapes: TokenShapes, evidence: Evidence, config: StreamConfig) -> TokenShapes:
    """`shapes` of pivots with opacity and scales changed as the evidence asks for.

    Limits:
        Logits change by at most `MAX_LOGIT_CHANGE`; the decoder bounds the scales.
    """
    out = EvidenceHead().apply({"params": params}, evidence_features(evidence, config))
    logit, sideways, along = jnp.moveaxis(jnp.asarray(out), -1, 0)
    change = MAX_LOGIT_CHANGE * jnp.tanh(logit / MAX_LOGIT_CHANGE)
    return replace(
        shapes,
        logit_opacities=shapes.logit_opacities + change,
        raw_scales=shapes.raw_scales + jnp.stack([sideways, sideways, along], axis=-1),
    )
