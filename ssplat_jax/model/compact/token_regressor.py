"""Token features before the history is injected (Sec. 3.3; ReSplat's regressor)."""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ssplat_jax.config import StreamConfig
from ssplat_jax.model.convolution import Conv, pixel_unshuffle
from ssplat_jax.model.layers import rms_normalize
from ssplat_jax.model.types import GRID_STRIDE, AnchoredDepth, DepthBelief, Features, Views

MIN_LOG_RANGE = 1e-3
"""A sweep narrower than this (a single candidate, near = far) gives a hint near 0, not 0 / 0."""


class TokenRegressor(nn.Module):
    """[patch, depth, match probability, context, decoder features] to f; patch and probability go in a second time."""

    config: StreamConfig

    @nn.compact
    def __call__(self, patches, relative_depths, match, context, decoder) -> Float[Array, "v hf wf c"]:
        c = self.config.network.token_width
        x = jnp.concatenate([patches, relative_depths, match, context, decoder], axis=-1)
        x = Conv(c, name="conv2")(nn.gelu(Conv(c, name="conv1")(x)))
        return nn.Dense(c, name="project")(jnp.concatenate([x, patches, match], axis=-1))


def regress_tokens(
    params, features: Features, belief: DepthBelief, depth: AnchoredDepth, views: Views, config: StreamConfig
) -> Float[Array, "v hf wf c"]:
    """f^v(u): what the current views say about each token, of unit RMS.

    What follows is residual and ends in a norm: nothing else would hold the size of f, and what CGFI and the mixer add
    would drown in large features. All that enters has about that size too: colors and confidence are few channels
    beside many.

    The depth enters as a constant: it is trained through the positions it gives, not through this hint.
    """
    low, high = views.log_candidates[0], views.log_candidates[-1]
    relative = (jax.lax.stop_gradient(depth.log_depths)[..., None] - low) / jnp.maximum(high - low, MIN_LOG_RANGE)
    match = 4.0 * (jax.lax.stop_gradient(depth.anchored_confidences)[..., None] - 0.75)
    patches = 4.0 * pixel_unshuffle(views.images - 0.5, GRID_STRIDE)
    context, decoder = (rms_normalize(x.astype(jnp.float32)) for x in (features.context, belief.decoder))
    feats = TokenRegressor(config).apply({"params": params}, patches, relative, match, context, decoder)
    return rms_normalize(feats)  # pyright: ignore[reportArgumentType]
