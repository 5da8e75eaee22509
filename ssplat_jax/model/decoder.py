"""Gaussian head: a two-layer MLP from a token's feature to its Gaussians, whose middle is its position (Sec. 3.7)."""

import math

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ssplat_jax.config import StreamConfig
from ssplat_jax.gaussians import SH_C0, Gaussians
from ssplat_jax.geometry.rotations import multiply_quats, quats_to_matrices
from ssplat_jax.model.types import TokenShapes

START_SCALE = 0.43  # of a Gaussian's share of the cell, sideways: neighbors overlap into a closed surface
START_THICKNESS = 0.05  # of the cell's footprint, along the viewing direction
MAX_LOG_GAIN = 0.3  # a Gaussian stays within a third of its cell's size: larger ones fill holes over what lies behind
MIN_SCALE = 1e-6


def token_scales(raw: Float[Array, "m 3"], footprints: Float[Array, " m"], config: StreamConfig) -> Float[Array, "m 3"]:
    """Standard deviations of each Gaussian of a token in stream units, along the axes of the token's camera."""
    side = math.isqrt(config.head.gaussians_per_token)
    if config.head.scale_mode == "absolute":
        scales = nn.softplus(raw - 4.0) / jnp.array([side, side, 1.0])
    else:
        start = jnp.array([START_SCALE / side, START_SCALE / side, START_THICKNESS])
        scales = footprints[:, None] * start * jnp.exp(MAX_LOG_GAIN * jnp.tanh(raw / MAX_LOG_GAIN))
    return jnp.clip(scales, MIN_SCALE, config.head.max_scale)


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
    """Gaussians of tokens or of cache pivots: `gaussians_per_token` of each, in a square over its cell, row by row.

    The head gives all of a token's the same shape and opacity; they differ in place and color. A pivot of n
    members stands for n tokens in one place and is as opaque as they would be, 1 - (1 - o)^n.

    The head's rotation is in the frame of the camera in `quats` (DESIGN 6.7); its color is a residual on the
    appearance anchors `rgbs` (DESIGN 6.6).
    """
    optical_depths = jnp.asarray(num_members, jnp.float32) * nn.softplus(shapes.opacity_logits)
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
    """Centers of the parts of each token's cell, row by row, in the plane that faces the camera in `quats`."""
    side = math.isqrt(config.head.gaussians_per_token)
    steps = (np.arange(side, dtype=np.float32) + 0.5) / side - 0.5  # of a cell
    down, right = (x.reshape(-1, 1) for x in np.meshgrid(steps, steps, indexing="ij"))
    axes = quats_to_matrices(quats)
    moves = right * axes[:, None, :, 0] + down * axes[:, None, :, 1]
    return (means[:, None] + footprints[:, None, None] * moves).reshape(-1, 3)
