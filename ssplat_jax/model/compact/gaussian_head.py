"""Gaussian head of the compact network: an MLP from features to shapes and colors (Sec. 3.6, Gaussian Decoder)."""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from ssplat_jax.config import StreamConfig
from ssplat_jax.model.types import TokenShapes

START_OPACITY = -0.6
"""Untrained logit of the opacity (0.35). Surfaces are several tokens deep; translucent ones average their errors."""


class GaussianHead(nn.Module):
    """Maps features to raw opacity, scale, rotation and SH residual, all close to zero before training."""

    config: StreamConfig

    @nn.compact
    def __call__(self, feats: Float[Array, "m c"]) -> Float[Array, "m o"]:
        outputs = 1 + 3 + 4 + 3 * (self.config.head.sh_degree + 1) ** 2
        hidden = nn.gelu(nn.Dense(feats.shape[-1], name="hidden")(nn.LayerNorm(name="norm")(feats)))
        # Zero mean: otherwise gradients common to all tokens, which belong to the bias, would outweigh the others.
        hidden = nn.LayerNorm(use_bias=False, use_scale=False)(hidden)
        return nn.Dense(outputs, kernel_init=nn.initializers.normal(1e-3), name="out")(hidden)


def read_shapes(params, feats: Float[Array, "m c"], config: StreamConfig) -> TokenShapes:
    """Shapes predicted from features of any float dtype, in float32."""
    raw = GaussianHead(config).apply({"params": params}, feats.astype(jnp.float32))
    opacity, scale, rotation, sh = jnp.split(raw, [1, 4, 8], axis=-1)  # pyright: ignore[reportArgumentType]
    return TokenShapes(
        logit_opacities=opacity[:, 0] + START_OPACITY,
        raw_scales=scale,
        quats=rotation + jnp.array([1.0, 0.0, 0.0, 0.0]),
        sh=sh.reshape(feats.shape[0], -1, 3),
    )
