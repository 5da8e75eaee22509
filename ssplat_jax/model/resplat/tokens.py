"""Token features before the history comes in (ReSplat; ALGORITHM 3.1)."""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from ssplat_jax.config import StreamConfig
from ssplat_jax.model.convolution import Conv, pixel_shuffle, pixel_unshuffle
from ssplat_jax.model.resplat.swin_layers import ReSplatFeatures, resize
from ssplat_jax.model.types import GRID_STRIDE, AnchoredDepth, DepthBelief, Views, repeat_cells


class TokenRegressor(nn.Module):
    """[patch, depth, match probability, features] to f; patch, features and probability go in a second time."""

    config: StreamConfig

    @nn.compact
    def __call__(self, patches, depths, match, features) -> Float[Array, "v hf wf c"]:
        c = self.config.network.token_width
        x = jnp.concatenate([patches, depths, match, features], axis=-1)
        x = nn.gelu(Conv(c, name="gaussian_regressor_0")(x), approximate=False)
        x = Conv(c, name="gaussian_regressor_2")(x)
        return nn.Dense(c, name="proj")(jnp.concatenate([x, patches, features, match], axis=-1))


def token_context(features: ReSplatFeatures, height: int, width: int) -> Float[Array, "v hf wf c"]:
    """All that the encoder saw, on a grid of `height` x `width`: ViT, CNN, multi-view features."""
    mono = [pixel_shuffle(resize(x, height // 4, width // 4), 4) for x in features.mono]
    maps = [resize(x, height, width) for x in (*features.cnn, features.multiview)]
    return jnp.concatenate([*mono, *maps], axis=-1)


def regress_tokens(
    params, features: ReSplatFeatures, belief: DepthBelief, depth: AnchoredDepth, views: Views, config: StreamConfig
) -> Float[Array, "v hf wf c"]:
    """f^v(u): what the current views say about each token."""
    del belief  # the match probability is that of the depth that is used
    _, hf, wf = depth.log_depths.shape
    patches = pixel_unshuffle(views.images, GRID_STRIDE)
    match = repeat_cells(depth.probs.max(axis=-1, keepdims=True), config.network.match_stride // GRID_STRIDE)
    context = token_context(features, hf, wf)
    depths = jnp.exp(depth.log_depths)[..., None]
    return TokenRegressor(config).apply({"params": params}, patches, depths, match, context)  # pyright: ignore[reportReturnType]
