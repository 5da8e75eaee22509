"""Gaussian head: a two-layer MLP from a token's feature to its Gaussian (ReSplat; ALGORITHM 3.3)."""

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ssplat_jax.config import StreamConfig
from ssplat_jax.model.types import TokenShapes

ROWS = (4, 3, 1, 2)
"""Rotation (xyzw), scale, opacity, offset in the pixel; then color coefficients. Offsets are not used: a pivot's
Gaussian stands where its tokens are (ALGORITHM 9.32)."""


class GaussianHead(nn.Module):
    """Feature to raw rotation, scale, opacity, offset and SH residual; all but the rotation zero before training."""

    config: StreamConfig

    @nn.compact
    def __call__(self, feats: Float[Array, "m c"]) -> Float[Array, "m o"]:
        outputs = sum(ROWS) + 3 * (self.config.head.sh_degree + 1) ** 2
        hidden = nn.gelu(nn.Dense(outputs, name="gaussian_head_0")(feats), approximate=False)
        return nn.Dense(outputs, kernel_init=nn.initializers.normal(1e-3), name="gaussian_head_2")(hidden)


def read_shapes(params, feats: Float[Array, "m c"], config: StreamConfig) -> TokenShapes:
    """What the head makes of features of any precision, read in float32."""
    raw = GaussianHead(config).apply({"params": params}, feats.astype(jnp.float32))
    rotation, scale, opacity, _, sh = jnp.split(raw, np.cumsum(ROWS).tolist(), axis=-1)  # pyright: ignore[reportArgumentType]
    return TokenShapes(
        opacity_logits=opacity[:, 0],
        raw_scales=scale,
        quats=jnp.roll(rotation, 1, axis=-1),
        sh=sh.reshape(feats.shape[0], 3, -1).swapaxes(1, 2),
    )
