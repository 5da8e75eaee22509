"""Gaussians of tokens, from the shapes that the head predicts (Sec. 3.6, Gaussian Decoder)."""

import math

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ssplat_jax.config import StreamConfig
from ssplat_jax.core.gaussians import SH_C0, Gaussians
from ssplat_jax.core.rotations import multiply_quats, quats_to_matrices
from ssplat_jax.model.types import TokenShapes

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


def token_scales(raw: Float[Array, "m 3"], footprints: Float[Array, " m"], config: StreamConfig) -> Float[Array, "m 3"]:
    """Standard deviations of each token's Gaussians in stream units, along the axes of the token's camera."""
    side = math.isqrt(config.head.gaussians_per_token)
    if not config.additions.footprint_scales:
        scales = nn.softplus(raw - 4.0) / jnp.array([side, side, 1.0])
    else:
        start = jnp.array([START_SCALE / side, START_SCALE / side, START_THICKNESS])
        scales = footprints[:, None] * start * jnp.exp(MAX_LOG_GAIN * jnp.tanh(raw / MAX_LOG_GAIN))
    return jnp.clip(scales, MIN_SCALE, MAX_SCALE)


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
        shapes: what the head predicts. Rotations are in the frame of the token's camera, `shapes.sh` is a residual on
            the appearance anchors.
        means: positions of the tokens, stream frame.
        rgbs: appearance anchors: a color in [0, 1] per Gaussian of the token.
        quats: camera-to-stream rotation of each token's camera, wxyz.
        footprints: side of a cell at the token's depth, stream units.
        num_members: tokens that were merged into the pivot.
        config: model configuration.

    Returns:
        Gaussians token by token, stream frame.
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
