"""Tokens of ReSplat's network: features of the current views, and the shapes read from them."""

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ssplat_jax.config import StreamConfig
from ssplat_jax.model.layers import Conv, pixel_shuffle, pixel_unshuffle
from ssplat_jax.model.resplat.torch_layers import ReSplatFeatures, resize
from ssplat_jax.model.views import GRID_STRIDE, AnchoredDepth, DepthDistribution, TokenShapes, Views, repeat_cells


class ReSplatTokenRegressor(nn.Module):
    """Maps [patch, depth, match probability, context] to f, with a skip for all but the depth."""

    config: StreamConfig

    @nn.compact
    def __call__(self, patches, depths, match, features) -> Float[Array, "v hf wf c"]:
        c = self.config.network.token_width
        x = jnp.concatenate([patches, depths, match, features], axis=-1)
        x = nn.gelu(Conv(c, name="gaussian_regressor_0")(x), approximate=False)
        x = Conv(c, name="gaussian_regressor_2")(x)
        return nn.Dense(c, name="proj")(jnp.concatenate([x, patches, features, match], axis=-1))


def token_context(features: ReSplatFeatures, height: int, width: int) -> Float[Array, "v hf wf c"]:
    """Encoder features on a grid of `height` x `width` cells: ViT, CNN, multi-view."""
    mono = [pixel_shuffle(resize(x, height // 4, width // 4), 4) for x in features.mono]
    maps = [resize(x, height, width) for x in (*features.cnn, features.multiview)]
    return jnp.concatenate([*mono, *maps], axis=-1)


def regress_tokens(
    params,
    features: ReSplatFeatures,
    distribution: DepthDistribution,
    depth: AnchoredDepth,
    views: Views,
    config: StreamConfig,
) -> Float[Array, "v hf wf c"]:
    """Token features f^v(u) of the current views."""
    del distribution  # the match probability is that of the anchored depth
    _, hf, wf = depth.log_depths.shape
    patches = pixel_unshuffle(views.images, GRID_STRIDE)
    match = repeat_cells(depth.probs.max(axis=-1, keepdims=True), config.network.match_stride // GRID_STRIDE)
    context = token_context(features, hf, wf)
    depths = jnp.exp(depth.log_depths)[..., None]
    return ReSplatTokenRegressor(config).apply({"params": params}, patches, depths, match, context)  # pyright: ignore[reportReturnType]


# -- Gaussian head: a two-layer MLP -----------------------------------------------------------------------------------

ROWS = (4, 3, 1, 2)
"""Widths of rotation (xyzw), scale, opacity and offset in the output; color coefficients follow. The offset in the
pixel is not used: a pivot's Gaussian is at the pivot's position."""


class ReSplatGaussianHead(nn.Module):
    """Maps features to raw rotation, scale, opacity, offset and SH residual."""

    config: StreamConfig

    @nn.compact
    def __call__(self, feats: Float[Array, "m c"]) -> Float[Array, "m o"]:
        outputs = sum(ROWS) + 3 * (self.config.head.sh_degree + 1) ** 2
        hidden = nn.gelu(nn.Dense(outputs, name="gaussian_head_0")(feats), approximate=False)
        return nn.Dense(outputs, kernel_init=nn.initializers.normal(1e-3), name="gaussian_head_2")(hidden)


def read_shapes(params, feats: Float[Array, "m c"], config: StreamConfig) -> TokenShapes:
    """Shapes predicted from features of any float dtype, in float32."""
    raw = ReSplatGaussianHead(config).apply({"params": params}, feats.astype(jnp.float32))
    rotation, scale, opacity, _, sh = jnp.split(raw, np.cumsum(ROWS).tolist(), axis=-1)  # pyright: ignore[reportArgumentType]
    return TokenShapes(
        logit_opacities=opacity[:, 0],
        raw_scales=scale,
        quats=jnp.roll(rotation, 1, axis=-1),
        sh=sh.reshape(feats.shape[0], 3, -1).swapaxes(1, 2),
    )
