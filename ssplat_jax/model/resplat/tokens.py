"""Token features of ReSplat's network, before history is injected."""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from ssplat_jax.config import StreamConfig
from ssplat_jax.model.convolution import Conv, pixel_shuffle, pixel_unshuffle
from ssplat_jax.model.resplat.resplat_features import ReSplatFeatures
from ssplat_jax.model.resplat.torch_layers import resize
from ssplat_jax.model.types import GRID_STRIDE, AnchoredDepth, DepthDistribution, Views, repeat_cells


class TokenRegressor(nn.Module):
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
    return TokenRegressor(config).apply({"params": params}, patches, depths, match, context)  # pyright: ignore[reportReturnType]
