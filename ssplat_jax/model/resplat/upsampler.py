"""Depth upsampler: a dense prediction head (DPT) over ViT features adds a residual to the upsampled depth."""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from ssplat_jax.config import StreamConfig
from ssplat_jax.model.layers import Conv, HalvingConv
from ssplat_jax.model.resplat.torch_layers import EdgePaddedConv, ReSplatFeatures, TransposedConv, resize
from ssplat_jax.model.views import (
    GRID_STRIDE,
    AnchoredDepth,
    Views,
    from_candidate_space,
    repeat_cells,
    to_candidate_space,
)

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
        x = nn.gelu(EdgePaddedConv(16, name="output_conv_0")(x), approximate=False)
        x = nn.gelu(EdgePaddedConv(16, name="output_conv_2")(x), approximate=False)
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
