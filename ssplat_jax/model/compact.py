"""The compact network, small enough for a CPU (ours): encoder, plane sweep, token regressor and Gaussian head."""

import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ssplat_jax.config import StreamConfig
from ssplat_jax.core.numerics import bilinear_taps, correlate_warped, safe_normalize
from ssplat_jax.core.pytree import pytree
from ssplat_jax.model.layers import (
    Conv,
    HalvingConv,
    ResidualBlock,
    UNet,
    WindowAttention,
    attend_in_windows,
    average_pool,
    instance_norm,
    normalize_images,
    pixel_unshuffle,
    rms_normalize,
)
from ssplat_jax.model.mixer import Mixer
from ssplat_jax.model.views import (
    GRID_STRIDE,
    AnchoredDepth,
    DepthDistribution,
    TokenShapes,
    Views,
    mean_over_sources,
    nearest_sources,
    sweep_pixels,
)

# -- Encoder: a CNN, then windowed self-attention and cross-view attention (as in DepthSplat) -------------------------


@pytree
class CompactFeatures:
    """Output of the encoder."""

    fine: Float[Array, "v h2 w2 cm"]  # matching features at 1/2 of the padded image
    grid: Float[Array, "v hf wf cm"]  # matching features at 1/4, after cross-view attention
    context: Float[Array, "v hf wf c"]  # CNN and multi-view features at 1/4


class Encoder(nn.Module):
    """Maps images to matching features at 1/2 and 1/4 and context features at 1/4."""

    config: StreamConfig

    def setup(self):
        network = self.config.network
        fine, grid = network.encoder_widths
        blocks, attention = range(network.encoder_blocks), range(network.attention_blocks)
        self.stem = HalvingConv(fine, 7, use_bias=False)
        self.fine_blocks = [ResidualBlock(fine) for _ in blocks]
        self.grid_blocks = [ResidualBlock(grid, stride=2 if i == 0 else 1) for i in blocks]
        self.project = Conv(grid, 1)
        self.self_attention = [WindowAttention() for _ in attention]
        self.cross_attention = [WindowAttention(network.attention_ffn) for _ in attention]
        self.match_fine, self.match_grid = (Conv(network.match_width, 1) for _ in range(2))

    def __call__(
        self, images: Float[Array, "v h w 3"], sources: Int[Array, "v s"], source_valid: Bool[Array, "v s"]
    ) -> CompactFeatures:
        x = nn.relu(instance_norm(self.stem(normalize_images(images))))
        for block in self.fine_blocks:
            x = block(x)
        fine = x
        for block in self.grid_blocks:
            x = block(x)
        cnn = self.project(x)
        attended = self.attend_views(cnn, sources, source_valid)
        context = jnp.concatenate([cnn, attended], axis=-1)
        return CompactFeatures(fine=self.match_fine(fine), grid=self.match_grid(attended), context=context)

    def attend_views(self, cnn, sources, source_valid):
        """CNN features after alternating attention within each view and to the same window of its source views."""
        side = self.config.network.attention_window

        def block(i, windows, gather, together, allowed):
            windows = self.self_attention[i](windows, windows, together)
            return self.cross_attention[i](windows, gather(windows), allowed)

        return attend_in_windows(cnn, (side, side), len(self.self_attention), sources, source_valid, block)


def encode(params, views: Views, config: StreamConfig) -> CompactFeatures:
    """Features of each view, with attention to its source views."""
    sources, source_valid = nearest_sources(views.viewmats, views.valid, config.network.num_sources)
    return Encoder(config).apply({"params": params}, views.images, sources, source_valid)  # pyright: ignore[reportReturnType]


# -- Plane sweep and cost-volume U-Net: P_i(k | u) from the chunk alone (Sec. 3.3) ------------------------------------
def plane_sweep(features: CompactFeatures, views: Views, config: StreamConfig) -> Float[Array, "v hf wf dl"]:
    """Cost volume: mean cosine of each cell with its source views at every candidate, at one or two scales.

    The mean is over the valid source views that see the candidate.

    Limits:
        A candidate that no source sees scores 0.
        Without parallax (equal centers, a pure rotation), a pair of views gives all candidates that it sees one score.
        Zero features score 0, equal features 1.
    """
    v, hf, wf = views.inside.shape
    unit = functools.partial(safe_normalize, eps=1e-6)  # then dot products are cosines
    maps = [(GRID_STRIDE, unit(features.grid), unit(features.grid))]
    if config.network.fine_matching:
        # A cell's center is the common corner of 2 x 2 fine pixels: their mean is the bilinear sample there.
        maps.append((GRID_STRIDE // 2, unit(average_pool(features.fine, 2)), unit(features.fine)))

    def correlate_pair(pair):
        reference, source, is_valid = pair
        x, y, seen = jax.lax.stop_gradient(sweep_pixels(views, reference, source, GRID_STRIDE))
        seen = seen & is_valid
        scores = []
        for stride, reference_map, source_map in maps:
            taps = bilinear_taps(x / stride - 0.5, y / stride - 0.5, *source_map.shape[1:3])
            flat_reference = reference_map[reference].reshape(-1, reference_map.shape[-1])
            score = correlate_warped(flat_reference, source_map[source], taps)
            scores.append(jnp.where(seen, score, 0.0))
        return jnp.stack(scores), seen

    return mean_over_sources(correlate_pair, views, config).reshape(v, -1, hf, wf).transpose(0, 2, 3, 1)


class CostVolume(nn.Module):
    """U-Net over [cost, context]. Logits start as the scaled cost, so that an untrained network already matches."""

    config: StreamConfig

    def setup(self):
        width = self.config.network.unet_width
        self.enter = Conv(width)
        self.enter_norm = nn.GroupNorm(8)
        self.unet = UNet(width)
        self.leave = Conv(width)
        self.skip = Conv(width, 1)
        self.head1 = Conv(width)
        self.head2 = Conv(self.config.network.num_depths, kernel_init=nn.initializers.normal(1e-3))
        levels = 2 if self.config.network.fine_matching else 1
        self.log_temperatures = self.param("log_temperatures", nn.initializers.constant(2.0), (levels,))

    def __call__(
        self, cost: Float[Array, "v hf wf dl"], context: Float[Array, "v hf wf c"], view_valid: Bool[Array, " v"]
    ) -> DepthDistribution:
        v, hf, wf, _ = cost.shape
        levels = self.log_temperatures.shape[0]
        scaled = cost.reshape(v, hf, wf, levels, -1) * jnp.exp(self.log_temperatures)[:, None]
        x = jnp.concatenate([scaled.reshape(v, hf, wf, -1), context], axis=-1)
        y = self.unet(nn.gelu(self.enter_norm(self.enter(x))), view_valid)
        decoder = self.leave(y) + self.skip(x)
        logits = scaled.sum(axis=3) + self.head2(nn.gelu(self.head1(decoder)))
        return DepthDistribution(probs=jax.nn.softmax(logits, axis=-1), logits=logits, decoder=decoder)


def match(params, features: CompactFeatures, views: Views, config: StreamConfig) -> DepthDistribution:
    """P_i(k | u) by plane sweep, U-Net and softmax, in float32 for features of any float dtype."""
    features = jax.tree.map(lambda x: x.astype(jnp.float32), features)
    cost = plane_sweep(features, views, config)
    return CostVolume(config).apply({"params": params}, cost, features.context, views.valid)  # pyright: ignore[reportReturnType]


# -- Tokens: features of the current views, mixed in 3D ---------------------------------------------------------------

MIN_LOG_RANGE = 1e-3  # lower bound of the range that log depths are divided by, for a single candidate and near = far


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


def mix_tokens(params, feats, positions, inside, view_valid, config: StreamConfig) -> Float[Array, "v hf wf c"]:
    """Mixed token features, for the head and the cache; of unit RMS with `additions.unit_features`.

    Stored features come back through CGFI with the next chunk. Without a bound they grow from chunk to chunk: trained
    on four chunks, they reached 1e18 by the ninth. The input is brought to unit RMS too, because nothing else bounds
    what CGFI adds, and large features would outweigh the output of the blocks.
    """
    bound = rms_normalize if config.additions.unit_features else lambda x: x
    feats = bound(feats.astype(jnp.float32))
    return bound(Mixer(config).apply({"params": params}, feats, positions, inside, view_valid))  # pyright: ignore


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


# -- All stages -------------------------------------------------------------------------------------------------------
def stages(config: StreamConfig) -> dict:
    """Linen module and example inputs of every stage."""
    v, side, c = 2, config.network.attention_window, config.network.token_width
    images = jnp.zeros((v, 4 * side, 4 * side, 3))
    sources = jnp.zeros((v, 1), jnp.int32)
    grid = lambda channels: jnp.zeros((v, side, side, channels))  # noqa: E731
    inside, valid = jnp.ones((v, side, side), bool), jnp.ones(v, bool)
    levels = 2 if config.network.fine_matching else 1
    context = grid(2 * config.network.encoder_widths[1])
    return {
        "encoder": (Encoder(config), (images, sources, valid[:, None])),
        "cost_volume": (CostVolume(config), (grid(levels * config.network.num_depths), context, valid)),
        "tokens": (TokenRegressor(config), (grid(48), grid(1), grid(1), context, grid(config.network.unet_width))),
        "mixer": (Mixer(config), (grid(c), grid(3), inside, valid)),
        "decoder": (GaussianHead(config), (jnp.zeros((1, c)),)),
    }


class CompactNetwork:
    """The stages of the compact network; fulfils `ssplat_jax.model.network.Network`."""

    stages = staticmethod(stages)
    encode = staticmethod(encode)
    match = staticmethod(match)
    refine_depth = staticmethod(lambda params, features, depth, views, config: depth)  # both grids are the same
    regress_tokens = staticmethod(regress_tokens)
    bound_history = staticmethod(lambda feats: feats)  # `mix_tokens` ends in a norm
    mix_tokens = staticmethod(mix_tokens)
    read_shapes = staticmethod(read_shapes)
