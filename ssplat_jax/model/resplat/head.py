"""Gaussian head of ReSplat's network: a two-layer MLP from a token's feature to the shape of its Gaussian."""

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ssplat_jax.config import StreamConfig
from ssplat_jax.model.types import TokenShapes

ROWS = (4, 3, 1, 2)
"""Widths of rotation (xyzw), scale, opacity and offset in the output; color coefficients follow. The offset in the
pixel is not used: a pivot's Gaussian is at the pivot's position."""


class GaussianHead(nn.Module):
    """Maps features to raw rotation, scale, opacity, offset and SH residual."""

    config: StreamConfig

    @nn.compact
    def __call__(self, feats: Float[Array, "m c"]) -> Float[Array, "m o"]:
        outputs = sum(ROWS) + 3 * (self.config.head.sh_degree + 1) ** 2
        hidden = nn.gelu(nn.Dense(outputs, name="gaussian_head_0")(feats), approximate=False)
        return nn.Dense(outputs, kernel_init=nn.initializers.normal(1e-3), name="gaussian_head_2")(hidden)


def read_shapes(params, feats: Float[Array, "m c"], config: StreamConfig) -> TokenShapes:
    """Shapes predicted from features of any float dtype, in float32."""
    raw = GaussianHead(config).apply({"params": params}, feats.astype(jnp.float32))
    rotation, scale, opacity, _, sh = jnp.split(raw, np.cumsum(ROWS).tolist(), axis=-1)  # pyright: ignore[reportArgumentType]
    return TokenShapes(
        logit_opacities=opacity[:, 0],
        raw_scales=scale,
        quats=jnp.roll(rotation, 1, axis=-1),
        sh=sh.reshape(feats.shape[0], 3, -1).swapaxes(1, 2),
    )
