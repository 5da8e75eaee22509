"""Image encoder: a CNN, a multi-view transformer and a vision transformer (as in DepthSplat)."""

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ssplat_jax.config import StreamConfig
from ssplat_jax.model.convolution import Conv, HalvingConv
from ssplat_jax.model.layers import ResidualBlock, attend, instance_norm, normalize_images
from ssplat_jax.model.resplat.resplat_features import ReSplatFeatures
from ssplat_jax.model.resplat.torch_layers import layer_norm
from ssplat_jax.model.resplat.vit import VisionTransformer
from ssplat_jax.model.types import Views, nearest_sources
from ssplat_jax.model.windows import from_windows, same_region_mask, sine_positions, to_windows

WIDTHS = (64, 96, 128)
"""Channels of the three CNN levels."""
NUM_BLOCKS = 6
"""Blocks of the multi-view transformer."""
FFN_RATIO = 4
"""Ratio of the feed-forward width to the width of [input, message]."""


class Backbone(nn.Module):
    """CNN features at three levels: the first at 1/2 of the image, the last on the matching grid."""

    match_stride: int

    @nn.compact
    def __call__(self, x: Float[Array, "v h w 3"]) -> tuple[Array, Array, Array]:
        x = nn.relu(instance_norm(HalvingConv(WIDTHS[0], 7, use_bias=False, name="conv1")(x)))
        maps = []
        for level, (features, stride) in enumerate(zip(WIDTHS, (1, self.match_stride // 4, 2), strict=True), 1):
            x = ResidualBlock(features, stride, "downsample_0", name=f"layer{level}_0")(x)
            x = ResidualBlock(features, name=f"layer{level}_1")(x)
            maps.append(x)
        return maps[0], maps[1], Conv(WIDTHS[2], 1, name="conv2")(x)


class AttentionLayer(nn.Module):
    """Residual one-head attention in windows, with an optional feed-forward layer on [input, message]."""

    has_ffn: bool = False

    @nn.compact
    def __call__(self, x, context, allowed):
        c = x.shape[-1]
        dense = lambda features, name: nn.Dense(features, use_bias=False, name=name)  # noqa: E731
        q, k, v = dense(c, "q_proj")(x), dense(c, "k_proj")(context), dense(c, "v_proj")(context)
        message = attend(q[..., None, :], k[..., None, :], v[..., None, :], allowed)[..., 0, :]
        message = layer_norm("norm1")(dense(c, "merge")(message))
        if self.has_ffn:
            hidden = dense(FFN_RATIO * 2 * c, "mlp_0")(jnp.concatenate([x, message], axis=-1))
            message = layer_norm("norm2")(dense(c, "mlp_2")(nn.gelu(hidden, approximate=False)))
        return x + message


class TransformerBlock(nn.Module):
    """Attention within each view, then to the same window of its source views as they entered the block."""

    @nn.compact
    def __call__(self, windows, sources, together, allowed):
        v, n, cells, c = windows.shape
        context = windows[sources].transpose(0, 2, 1, 3, 4).reshape(v, n, sources.shape[1] * cells, c)
        windows = AttentionLayer(name="self_attn")(windows, windows, together)
        return AttentionLayer(has_ffn=True, name="cross_attn_ffn")(windows, context, allowed)


class Transformer(nn.Module):
    """Six blocks of windowed attention; every other block shifts the windows by half a window."""

    upstream_compat: bool

    @nn.compact
    def __call__(
        self, x: Float[Array, "v h w c"], sources: Int[Array, "v s"], source_valid: Bool[Array, "v s"]
    ) -> Float[Array, "v h w c"]:
        _, h, w, c = x.shape
        parts = num_windows(w)
        side = (h // parts, w // parts)
        x = x + jnp.tile(sine_positions(*side, c), (parts, parts, 1))
        cells = side[0] * side[1]
        for i in range(NUM_BLOCKS):
            shift = (side[0] // 2, side[1] // 2) if i % 2 else (0, 0)
            together = same_region_mask(h, w, side, shift)
            seen = jnp.repeat(source_valid, cells, axis=1)[:, None, None]
            windows = to_windows(jnp.roll(x, (-shift[0], -shift[1]), axis=(1, 2)), side)
            allowed = seen & self.source_mask(together, sources.shape[1])
            windows = TransformerBlock(name=f"layers_{i}")(windows, sources, together, allowed)
            x = jnp.roll(from_windows(windows, side, h, w), shift, axis=(1, 2))
        return x

    def source_mask(self, together: Bool[Array, "1 n q k"], num_sources: int) -> Bool[Array, "1 n q sk"]:
        """Keys of all sources that a cell may attend to: those of its own region.

        Upstream orders keys by cell but the mask by source, so that with several sources the mask of shifted windows
        selects wrong keys. Its weights were trained with that; `upstream_compat` reproduces it.
        """
        if not self.upstream_compat:
            return jnp.tile(together, num_sources)
        cells = together.shape[-1]
        source, cell = np.divmod(np.arange(num_sources * cells), cells)
        return together[..., (cell * num_sources + source) % cells]


def num_windows(width: int) -> int:
    """Windows along each side of a map of that width (ReSplat's rule)."""
    return 2 if width <= 96 else 4 if width <= 192 else 8


class Encoder(nn.Module):
    """Maps images to the features of all three branches."""

    config: StreamConfig

    @nn.compact
    def __call__(
        self, images: Float[Array, "v h w 3"], sources: Int[Array, "v s"], source_valid: Bool[Array, "v s"]
    ) -> ReSplatFeatures:
        images = normalize_images(images)
        cnn = Backbone(self.config.network.match_stride, name="backbone")(images)
        multiview = Transformer(self.config.network.upstream_compat, name="transformer")(cnn[-1], sources, source_valid)
        mono = VisionTransformer(self.config.network.vit, name="pretrained")(images)
        return ReSplatFeatures(cnn=cnn, multiview=multiview, mono=mono)


def encode(params, views: Views, config: StreamConfig) -> ReSplatFeatures:
    """Features of each view, with attention to its source views."""
    sources, source_valid = nearest_sources(views.viewmats, views.valid, config.network.num_sources)
    return Encoder(config).apply({"params": params}, views.images, sources, source_valid)  # pyright: ignore[reportReturnType]
