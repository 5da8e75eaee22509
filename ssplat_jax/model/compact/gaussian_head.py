"""Gaussian head: a two-layer MLP from a token's feature to the shape and color of its Gaussians (Sec. 3.7)."""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from ssplat_jax.config import StreamConfig
from ssplat_jax.model.types import TokenShapes

START_OPACITY = -0.6  # logit: 0.35; a surface is several tokens deep, and sheer ones average each other's errors


class GaussianHead(nn.Module):
    """Feature to raw opacity, scale, rotation and SH residual, all zero before training."""

    config: StreamConfig

    @nn.compact
    def __call__(self, feats: Float[Array, "m c"]) -> Float[Array, "m o"]:
        outputs = 1 + 3 + 4 + 3 * (self.config.head.sh_degree + 1) ** 2
        hidden = nn.gelu(nn.Dense(feats.shape[-1], name="hidden")(nn.LayerNorm(name="norm")(feats)))
        # Of mean 0: else what all tokens have in common, which a bias holds, moves faster than what tells them apart.
        hidden = nn.LayerNorm(use_bias=False, use_scale=False)(hidden)
        return nn.Dense(outputs, kernel_init=nn.initializers.normal(1e-3), name="out")(hidden)


def read_shapes(params, feats: Float[Array, "m c"], config: StreamConfig) -> TokenShapes:
    """What the head makes of features of any precision, read in float32."""
    raw = GaussianHead(config).apply({"params": params}, feats.astype(jnp.float32))
    opacity, scale, rotation, sh = jnp.split(raw, [1, 4, 8], axis=-1)  # pyright: ignore[reportArgumentType]
    return TokenShapes(
        opacity_logits=opacity[:, 0] + START_OPACITY,
        raw_scales=scale,
        quats=rotation + jnp.array([1.0, 0.0, 0.0, 0.0]),
        sh=sh.reshape(feats.shape[0], -1, 3),
    )
