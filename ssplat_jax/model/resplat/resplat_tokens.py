"""Depth upsampler, token regressor and Gaussian head of ReSplat's network, which follow the anchored depth."""

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ssplat_jax.config import StreamConfig
from ssplat_jax.model.layers import Conv, HalvingConv, pixel_shuffle, pixel_unshuffle
from ssplat_jax.model.resplat.torch_layers import ReSplatFeatures, TransposedConv, resize
from ssplat_jax.model.views import (
    GRID_STRIDE,
    AnchoredDepth,
    DepthDistribution,
    TokenShapes,
    Views,
    from_candidate_space,
    repeat_cells,
    to_candidate_space,
)

# -- Depth upsampler: a dense prediction head (DPT) over ViT features adds a residual to the upsampled depth ----------


SIZES = {
    # width of the fusion, channels of the four levels
    "s": (32, (48, 96, 192, 384)),
    "b": (48, (96, 192, 384, 768)),
    "l": (64, (256, 512, 1024, 1024)),
}
"""Widths by size of the vision transformer."""


class ResidualUnit(nn.Module):
    """Residual block: twice ReLU - conv."""

    features: int

    @nn.compact
    def __call__(self, x):
        y = Conv(self.features, name="conv1")(nn.relu(x))
        return x + Conv(self.features, name="conv2")(nn.relu(y))


class Fusion(nn.Module):
    """Fusion of one level with the coarser ones, resized to the next finer level."""

    features: int

    @nn.compact
    def __call__(self, x, level, height: int, width: int):
        if level is not None:
            x = x + ResidualUnit(self.features, name="resConfUnit1")(level)
        x = ResidualUnit(self.features, name="resConfUnit2")(x)
        return Conv(self.features, 1, name="out_conv")(resize(x, height, width))


class Scratch(nn.Module):
    """Fusion of the four-level pyramid to one map of the image's size."""

    features: int

    @nn.compact
    def __call__(self, levels, height: int, width: int):
        levels = [Conv(self.features, use_bias=False, name=f"layer{i + 1}_rn")(x) for i, x in enumerate(levels)]
        sizes = [(height, width)] + [x.shape[1:3] for x in levels[:3]]
        x = Fusion(self.features, name="refinenet4")(levels[3], None, *sizes[3])
        for i in (2, 1, 0):
            x = Fusion(self.features, name=f"refinenet{i + 1}")(x, levels[i], *sizes[i])
        x = nn.gelu(Conv(16, padding="edge", name="output_conv_0")(x), approximate=False)
        x = nn.gelu(Conv(16, padding="edge", name="output_conv_2")(x), approximate=False)
        return Conv(1, 1, name="output_conv_4")(x)


class Upsampler(nn.Module):
    """Residual on the upsampled depth, in the space of the candidates."""

    config: StreamConfig

    @nn.compact
    def __call__(
        self, features: ReSplatFeatures, depths: Float[Array, "v hm wm"], height: int, width: int
    ) -> Float[Array, "v h w"]:
        fused, channels = SIZES[self.config.network.vit]
        mono = [resize(x, height // 8, width // 8) for x in features.mono]
        mono = [Conv(c, 1, name=f"projects_{i}")(x) for i, (x, c) in enumerate(zip(mono, channels, strict=True))]
        levels = [
            TransposedConv(channels[0], 4, name="resize_layers_0")(mono[0]),
            TransposedConv(channels[1], 2, name="resize_layers_1")(mono[1]),
            mono[2],
            HalvingConv(channels[3], name="resize_layers_3")(mono[3]),
        ]
        half, middle, grid = features.cnn
        cnn_maps = [[half], [middle], [grid]] if self.config.network.match_stride == 8 else [[half, middle], [grid], []]
        # These join the level that has the matching grid's CNN features.
        match_maps = [features.multiview, depths[..., None]]
        for i, maps in enumerate(cnn_maps):
            joined = [*maps, levels[i], *(match_maps if maps and maps[-1] is grid else [])]
            levels[i] = Conv(channels[i], 1, name=f"concat_projects_{i}")(jnp.concatenate(joined, axis=-1))
        return Scratch(fused, name="scratch")(levels, height, width)[..., 0]


def refine_depth(
    params, features: ReSplatFeatures, depth: AnchoredDepth, views: Views, config: StreamConfig
) -> AnchoredDepth:
    """Anchored depth on the feature grid.

    Depths go from the matching grid to pixels, where the upsampler's residual is added, and from there to the feature
    grid. Confidences are those of the matching cell.

    Limits:
        Depths stay between the first and the last candidate.
    """
    height, width = views.images.shape[1:3]
    coarse = to_candidate_space(depth.log_depths, config)
    residual = Upsampler(config).apply({"params": params}, features, coarse, height, width)
    fine = resize(coarse[..., None], height, width)[..., 0] + residual  # pyright: ignore[reportOperatorIssue]
    ends = to_candidate_space(views.log_candidates[jnp.array([0, -1])], config)
    fine = jnp.exp(from_candidate_space(jnp.clip(fine, ends.min(), ends.max()), config))
    log_depths = jnp.log(resize(fine[..., None], height // GRID_STRIDE, width // GRID_STRIDE)[..., 0])
    factor = config.network.match_stride // GRID_STRIDE
    return AnchoredDepth(
        probs=depth.probs,
        log_depths=log_depths,
        matcher_confidences=repeat_cells(depth.matcher_confidences, factor),
        anchored_confidences=repeat_cells(depth.anchored_confidences, factor),
    )


# -- Tokens: features of the current views ----------------------------------------------------------------------------


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
    mono = [pixel_shuffle(resize(x, hf // 4, wf // 4), 4) for x in features.mono]
    context = jnp.concatenate([*mono, *(resize(x, hf, wf) for x in (*features.cnn, features.multiview))], axis=-1)
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
