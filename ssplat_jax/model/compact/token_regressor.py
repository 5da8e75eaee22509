"""Token features of the compact network, before history is injected (Sec. 3.3)."""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ssplat_jax.config import StreamConfig
from ssplat_jax.model.compact.compact_features import CompactFeatures
from ssplat_jax.model.convolution import Conv, pixel_unshuffle
from ssplat_jax.model.layers import rms_normalize
from ssplat_jax.model.types import GRID_STRIDE, AnchoredDepth, DepthDistribution, Views

MIN_LOG_RANGE = 1e-3
"""Lower bound of the range that log depths are divided by, for a single candidate and near = far."""


class TokenRegressor(nn.Module):
    """Maps [patch, depth, match probability, context, decoder features] to f, with a skip for patch and probability."""

    config: StreamConfig

    @nn.compact
    def __call__(self, patches, relative_depths, match, context, decoder) -> Float[Array, "v hf wf c"]:
        c = self.config.network.token_width
        x = jnp.concatenate([patches, relative_depths, match, context, decoder], axis=-1)
        x = Conv(c, name="conv2")(nn.gelu(Conv(c, name="conv1")(x)))
        return nn.Dense(c, name="project")(jnp.concatenate([x, patches, match], axis=-1))


def regress_tokens(
    params,
    features: CompactFeatures,
    distribution: DepthDistribution,
    depth: AnchoredDepth,
    views: Views,
    config: StreamConfig,
) -> Float[Array, "v hf wf c"]:
    """Token features f^v(u) of the current views; of unit RMS with `additions.unit_features`.

    The following stages are residual and end in a norm, so nothing else would bound f, and large features would
    outweigh what CGFI and the mixer add. The inputs have about unit size too: colors and confidence are few channels
    among many.

    Depth and confidence enter as constants: depth is trained through positions only.
    """
    low, high = views.log_candidates[0], views.log_candidates[-1]
    relative = (jax.lax.stop_gradient(depth.log_depths)[..., None] - low) / jnp.maximum(high - low, MIN_LOG_RANGE)
    match = 4.0 * (jax.lax.stop_gradient(depth.anchored_confidences)[..., None] - 0.75)
    patches = 4.0 * pixel_unshuffle(views.images - 0.5, GRID_STRIDE)
    context, decoder = (rms_normalize(x.astype(jnp.float32)) for x in (features.context, distribution.decoder))
    feats = TokenRegressor(config).apply({"params": params}, patches, relative, match, context, decoder)
    return rms_normalize(feats) if config.additions.unit_features else feats  # pyright: ignore
