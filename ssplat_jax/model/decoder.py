"""Gaussian head: a two-layer MLP from a token's feature to its Gaussian; centre = position, exactly (Sec. 3.7)."""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ssplat_jax.config import StreamConfig
from ssplat_jax.gaussians import SH_C0, Gaussians
from ssplat_jax.geometry.rotations import multiply_quats

START_OPACITY = -0.4  # logit: 0.4; a surface is several tokens deep, and sheer ones average each other's errors
START_SCALE = 0.43  # of a cell's footprint, sideways: neighbours overlap into a closed surface
START_THICKNESS = 0.4  # of the sideways scale, along the viewing direction
MAX_LOG_GAIN = 0.3  # a Gaussian stays within a third of its cell's size: larger ones fill holes over what lies behind
MIN_SCALE = 1e-6


class GaussianHead(nn.Module):
    """Feature to raw opacity, scale, rotation and SH residual, all zero before training."""

    config: StreamConfig

    @nn.compact
    def __call__(self, feats: Float[Array, "m c"]) -> Float[Array, "m o"]:
        outputs = 1 + 3 + 4 + 3 * (self.config.sh_degree + 1) ** 2
        hidden = nn.gelu(nn.Dense(feats.shape[-1], name="hidden")(nn.LayerNorm(name="norm")(feats)))
        # Of mean 0: else what all tokens have in common, which a bias holds, moves faster than what tells them apart.
        hidden = nn.LayerNorm(use_bias=False, use_scale=False)(hidden)
        return nn.Dense(outputs, kernel_init=nn.initializers.normal(1e-3), name="out")(hidden)


def token_scales(raw: Float[Array, "m 3"], footprints: Float[Array, " m"], config: StreamConfig) -> Float[Array, "m 3"]:
    """Standard deviations in stream units, along the axes of the token's camera."""
    if config.scale_mode == "absolute":
        scales = nn.softplus(raw - 4.0)
    else:
        start = START_SCALE * jnp.array([1.0, 1.0, START_THICKNESS])
        scales = footprints[:, None] * start * jnp.exp(MAX_LOG_GAIN * jnp.tanh(raw / MAX_LOG_GAIN))
    return jnp.clip(scales, MIN_SCALE, config.max_scale)


def decode_tokens(
    params,
    *,
    means: Float[Array, "m 3"],
    feats: Float[Array, "m c"],
    rgbs: Float[Array, "m 3"],
    quats: Float[Array, "m 4"],
    footprints: Float[Array, " m"],
    num_members: Int[Array, " m"] | int = 1,
    config: StreamConfig,
) -> Gaussians:
    """Gaussians of tokens or of cache pivots: one each.

    A pivot of n members stands for n tokens in one place and is as opaque as they would be, 1 - (1 - o)^n.

    The head's rotation is in the frame of the camera in `quats` (DESIGN 6.7); its colour is a residual on the
    appearance anchor `rgbs` (DESIGN 6.6). Features of any precision are read in float32.
    """
    raw = GaussianHead(config).apply({"params": params}, feats.astype(jnp.float32))
    opacity, scale, rotation, sh = jnp.split(raw, [1, 4, 8], axis=-1)  # pyright: ignore[reportArgumentType]
    sh = sh.reshape(feats.shape[0], -1, 3)
    base = jnp.zeros_like(sh).at[:, 0].set((rgbs - 0.5) / SH_C0)
    optical_depths = jnp.asarray(num_members, jnp.float32) * nn.softplus(opacity[:, 0] + START_OPACITY)
    return Gaussians(
        means=means,
        quats=multiply_quats(quats, rotation + jnp.array([1.0, 0.0, 0.0, 0.0])),
        scales=token_scales(scale, footprints, config),
        opacities=-jnp.expm1(-optical_depths),
        sh=sh + base,
    )
