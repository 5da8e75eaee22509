"""From the match grid to the pixels: a dense prediction head over the ViT adds what the sweep left (ALGORITHM 2.8)."""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from ssplat_jax.config import StreamConfig
from ssplat_jax.model.convolution import Conv, HalvingConv
from ssplat_jax.model.resplat.swin_layers import EdgeConv, GrowingConv, ReSplatFeatures, resize
from ssplat_jax.model.types import (
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


class ResidualUnit(nn.Module):
    """ReLU - conv twice, residual."""

    features: int

    @nn.compact
    def __call__(self, x):
        y = Conv(self.features, name="conv1")(nn.relu(x))
        return x + Conv(self.features, name="conv2")(nn.relu(y))


class Fusion(nn.Module):
    """A level joins what comes from the coarser ones; the result at the size of the next."""

    features: int

    @nn.compact
    def __call__(self, x, level, height: int, width: int):
        if level is not None:
            x = x + ResidualUnit(self.features, name="resConfUnit1")(level)
        x = ResidualUnit(self.features, name="resConfUnit2")(x)
        return Conv(self.features, 1, name="out_conv")(resize(x, height, width))


class Scratch(nn.Module):
    """The pyramid from four levels to one map of the image's size."""

    features: int

    @nn.compact
    def __call__(self, levels, height: int, width: int):
        levels = [Conv(self.features, use_bias=False, name=f"layer{i + 1}_rn")(x) for i, x in enumerate(levels)]
        sizes = [(height, width)] + [x.shape[1:3] for x in levels[:3]]
        x = Fusion(self.features, name="refinenet4")(levels[3], None, *sizes[3])
        for i in (2, 1, 0):
            x = Fusion(self.features, name=f"refinenet{i + 1}")(x, levels[i], *sizes[i])
        x = nn.gelu(EdgeConv(16, name="output_conv_0")(x), approximate=False)
        x = nn.gelu(EdgeConv(16, name="output_conv_2")(x), approximate=False)
        return Conv(1, 1, name="output_conv_4")(x)


class Upsampler(nn.Module):
    """What to add to the upsampled depth, in the space of the candidates."""

    config: StreamConfig

    @nn.compact
    def __call__(
        self, features: ReSplatFeatures, depths: Float[Array, "v hm wm"], height: int, width: int
    ) -> Float[Array, "v h w"]:
        fused, channels = SIZES[self.config.network.vit]
        mono = [resize(x, height // 8, width // 8) for x in features.mono]
        mono = [Conv(c, 1, name=f"projects_{i}")(x) for i, (x, c) in enumerate(zip(mono, channels, strict=True))]
        levels = [
            GrowingConv(channels[0], 4, name="resize_layers_0")(mono[0]),
            GrowingConv(channels[1], 2, name="resize_layers_1")(mono[1]),
            mono[2],
            HalvingConv(channels[3], name="resize_layers_3")(mono[3]),
        ]
        half, middle, grid = features.cnn
        before = [[half], [middle], [grid]] if self.config.network.match_stride == 8 else [[half, middle], [grid], []]
        behind = [features.multiview, depths[..., None]]  # where the match grid's own CNN features are
        for i, maps in enumerate(before):
            joined = [*maps, levels[i], *(behind if maps and maps[-1] is grid else [])]
            levels[i] = Conv(channels[i], 1, name=f"concat_projects_{i}")(jnp.concatenate(joined, axis=-1))
        return Scratch(fused, name="scratch")(levels, height, width)[..., 0]


def refine_depth(
    params, features: ReSplatFeatures, depth: AnchoredDepth, views: Views, config: StreamConfig
) -> AnchoredDepth:
    """The depths of the 1/4 grid, from those of the match grid by way of the pixels; confidences of the nearest cell.

    Limits:
        Depths stay between the first and the last candidate.
    """
    height, width = views.images.shape[1:3]
    coarse = to_candidate_space(depth.log_depths, config)
    residual = Upsampler(config).apply({"params": params}, features, coarse, height, width)
    fine = resize(coarse[..., None], height, width)[..., 0] + residual  # pyright: ignore[reportOperatorIssue]
    ends = to_candidate_space(views.log_candidates[jnp.array([0, -1])], config)
    fine = jnp.exp(from_candidate_space(jnp.clip(fine, ends.min(), ends.max()), config))
    latent = jnp.log(resize(fine[..., None], height // GRID_STRIDE, width // GRID_STRIDE)[..., 0])
    factor = config.network.match_stride // GRID_STRIDE
    return AnchoredDepth(
        probs=depth.probs,
        log_depths=latent,
        matcher_confidences=repeat_cells(depth.matcher_confidences, factor),
        anchored_confidences=repeat_cells(depth.anchored_confidences, factor),
    )
