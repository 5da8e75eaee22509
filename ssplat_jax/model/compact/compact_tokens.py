"""Tokens of the compact network: features of the current views, their mixing in 3D, and the shapes read from them."""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ssplat_jax.config import StreamConfig
from ssplat_jax.model.compact.compact_layers import CompactFeatures, GlobalBlock, NeighborBlock
from ssplat_jax.model.layers import Conv, nearest_tokens, pixel_unshuffle, rms_normalize
from ssplat_jax.model.views import GRID_STRIDE, AnchoredDepth, DepthDistribution, TokenShapes, Views

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


# -- 3D token mixer: attention to 3D neighbors, then among all views at 1/16 (as in ReSplat) --------------------------
class Mixer(nn.Module):
    """Alternating neighbor blocks and global blocks."""

    config: StreamConfig

    def setup(self):
        self.local_blocks = [NeighborBlock(self.config) for _ in range(self.config.network.mixer_blocks)]
        self.global_blocks = [GlobalBlock() for _ in range(self.config.network.mixer_blocks)]

    def __call__(
        self,
        feats: Float[Array, "v hf wf c"],
        positions: Float[Array, "v hf wf 3"],
        inside: Bool[Array, "v hf wf"],
        view_valid: Bool[Array, " v"],
    ) -> Float[Array, "v hf wf c"]:
        if not self.local_blocks:
            return feats
        network = self.config.network
        neighbors = nearest_tokens(
            jax.lax.stop_gradient(positions), inside, network.mixer_neighbors, network.mixer_radius
        )
        x = feats
        for local, joint in zip(self.local_blocks, self.global_blocks, strict=True):
            flat = local(x.reshape(-1, x.shape[-1]), neighbors, inside.reshape(-1))
            x = joint(flat.reshape(x.shape), view_valid)
        return x


def mix_tokens(
    params,
    feats: Float[Array, "v hf wf c"],
    positions: Float[Array, "v hf wf 3"],
    inside: Bool[Array, "v hf wf"],
    view_valid: Bool[Array, " v"],
    config: StreamConfig,
) -> Float[Array, "v hf wf c"]:
    """Mixed token features, for the head and the cache; of unit RMS with `additions.unit_features`.

    Stored features come back through CGFI with the next chunk. Without a bound they grow from chunk to chunk: trained
    on four chunks, they reached 1e18 by the ninth. The input is brought to unit RMS too, because nothing else bounds
    what CGFI adds, and large features would outweigh the output of the blocks.
    """
    bound = rms_normalize if config.additions.unit_features else lambda x: x
    feats = bound(feats.astype(jnp.float32))
    mixed = Mixer(config).apply({"params": params}, feats, positions, inside, view_valid)
    return bound(mixed)  # pyright: ignore[reportArgumentType, reportReturnType]


# -- Gaussian head: an MLP from features to shapes and colors (Sec. 3.6, Gaussian Decoder) ----------------------------

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
