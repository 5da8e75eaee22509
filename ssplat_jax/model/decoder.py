"""Gaussians of tokens and pivots, from the shapes that the head predicts (Sec. 3.6, Gaussian Decoder)."""

import math

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ssplat_jax.cache.state import NUM_OBSERVED
from ssplat_jax.cache.votes import observation_features
from ssplat_jax.config import StreamConfig
from ssplat_jax.core.gaussians import SH_C0, Gaussians
from ssplat_jax.core.numerics import safe_log, safe_sqrt
from ssplat_jax.core.pytree import pytree, replace
from ssplat_jax.core.rotations import multiply_quats, quats_to_matrices
from ssplat_jax.model.views import TokenShapes

START_SCALE = 0.43
"""Untrained sideways scale, as a fraction of a Gaussian's part of the cell: neighbors overlap to a closed surface."""
START_THICKNESS = 0.05
"""Untrained scale along the viewing direction, as a fraction of the cell's footprint."""
MAX_LOG_GAIN = 0.6
"""Bound of the log factor on a scale. Larger Gaussians would cover holes and hide what is behind."""
MIN_SCALE = 1e-6
"""Smallest scale, in stream units."""
MAX_SCALE = 1.0
"""Largest scale, in stream units: ReSplat's bound."""
VOXEL_COVERAGE = 1.2
"""Share of a voxel's face that its pivots cover together: above 1, because pivots gather in the middle of the voxel."""


def token_scales(raw: Float[Array, "m 3"], footprints: Float[Array, " m"], config: StreamConfig) -> Float[Array, "m 3"]:
    """Standard deviations of each token's Gaussians in stream units, along the axes of the token's camera."""
    side = math.isqrt(config.head.gaussians_per_token)
    if not config.additions.footprint_scales:
        scales = nn.softplus(raw - 4.0) / jnp.array([side, side, 1.0])
    else:
        start = jnp.array([START_SCALE / side, START_SCALE / side, START_THICKNESS])
        scales = footprints[:, None] * start * jnp.exp(MAX_LOG_GAIN * jnp.tanh(raw / MAX_LOG_GAIN))
    return jnp.clip(scales, MIN_SCALE, MAX_SCALE)


def grown_footprints(
    footprints: Float[Array, "*p"], num_members: Int[Array, "*p"], config: StreamConfig
) -> Float[Array, "*p"]:
    """Footprints of pivots, grown with the number of members until K pivots cover a voxel's face.

    A pivot stores the footprint of its best member. Where grid cells are much finer than voxels, many tokens merge into
    K pivots, whose stored footprints would leave cracks between them. Without `merged_coverage` they stay as stored.
    """
    if not config.additions.merged_coverage:
        return footprints
    share = VOXEL_COVERAGE * config.memory.voxel_size / math.sqrt(config.memory.pivots_per_voxel)
    grown = footprints * jnp.sqrt(num_members.astype(jnp.float32))
    return jnp.minimum(grown, jnp.maximum(footprints, share))


def decode_tokens(
    shapes: TokenShapes,
    *,
    means: Float[Array, "m 3"],
    rgbs: Float[Array, "m a"],
    quats: Float[Array, "m 4"],
    footprints: Float[Array, " m"],
    num_members: Int[Array, " m"] | int = 1,
    config: StreamConfig,
) -> Gaussians:
    """Gaussians of tokens or pivots: `gaussians_per_token` each, in a square over the cell, row by row.

    The Gaussians of a token share shape and opacity and differ in position and color. With `merged_coverage` a
    pivot of n members is as opaque as n Gaussians of opacity o at one place, 1 - (1 - o)^n.

    Args:
        shapes: what the head predicts. Rotations are in the frame of the token's camera, `shapes.sh` is added to the
            appearance anchors.
        means: positions of the tokens, stream frame, as is the result.
        rgbs: appearance anchors: a color in [0, 1] per Gaussian of the token.
        quats: camera-to-stream rotation of each token's camera, wxyz.
        footprints: side of a cell at the token's depth, stream units.
        num_members: tokens that were merged into the pivot.
        config: model configuration.
    """
    layers = jnp.asarray(num_members, jnp.float32) if config.additions.merged_coverage else 1.0
    optical_depths = layers * nn.softplus(shapes.logit_opacities)
    each = lambda x: jnp.repeat(x, config.head.gaussians_per_token, axis=0)  # noqa: E731
    return Gaussians(
        means=_spread(means, quats, footprints, config),
        quats=each(multiply_quats(quats, shapes.quats)),
        scales=each(token_scales(shapes.raw_scales, footprints, config)),
        opacities=each(-jnp.expm1(-optical_depths)),
        sh=each(shapes.sh).at[:, 0].add((rgbs.reshape(-1, 3) - 0.5) / SH_C0),
    )


def _spread(
    means: Float[Array, "m 3"], quats: Float[Array, "m 4"], footprints: Float[Array, " m"], config: StreamConfig
) -> Float[Array, "n 3"]:
    """Centers of the parts of each cell, row by row, in the plane that faces the token's camera."""
    side = math.isqrt(config.head.gaussians_per_token)
    steps = (np.arange(side, dtype=np.float32) + 0.5) / side - 0.5  # in cells
    down, right = (x.reshape(-1, 1) for x in np.meshgrid(steps, steps, indexing="ij"))
    axes = quats_to_matrices(quats)
    offsets = right * axes[:, None, :, 0] + down * axes[:, None, :, 1]
    return (means[:, None] + footprints[:, None, None] * offsets).reshape(-1, 3)


# -- Evidence head: opacity, scale and contrast of a pivot's Gaussians from how views saw it (ours) -------------------

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

    Returns the shapes with other opacities and scales, and the colors, whose mean over a pivot stays as it is.

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
