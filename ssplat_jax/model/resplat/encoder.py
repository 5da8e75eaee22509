"""Image encoder: CNN, multi-view transformer and ViT (DepthSplat; ALGORITHM 2.2 to 2.4)."""

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ssplat_jax.config import StreamConfig
from ssplat_jax.model.convolution import Conv, HalvingConv
from ssplat_jax.model.layers import ResidualBlock, attend, instance_norm, normalize_images
from ssplat_jax.model.resplat.swin_layers import ReSplatFeatures
from ssplat_jax.model.resplat.vit import VisionTransformer
from ssplat_jax.model.types import Views, nearest_sources
from ssplat_jax.model.windows import from_windows, in_one_region, sine_positions, to_windows

WIDTHS = (64, 96, 128)
NUM_BLOCKS = 6
FFN_RATIO = 4  # of [source, message]


class Backbone(nn.Module):
    """Features of 64, 96 and 128 channels; the last on the match grid, the first at 1/2."""

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
    """One-head attention of windows, LayerNorm after the merge; optionally a feed-forward on [source, message]."""

    has_ffn: bool = False

    @nn.compact
    def __call__(self, x, context, allowed):
        c = x.shape[-1]
        dense = lambda features, name: nn.Dense(features, use_bias=False, name=name)  # noqa: E731
        norm = lambda name: nn.LayerNorm(epsilon=1e-5, use_fast_variance=False, name=name)  # noqa: E731
        q, k, v = dense(c, "q_proj")(x), dense(c, "k_proj")(context), dense(c, "v_proj")(context)
        message = attend(q[..., None, :], k[..., None, :], v[..., None, :], allowed)[..., 0, :]
        message = norm("norm1")(dense(c, "merge")(message))
        if self.has_ffn:
            hidden = dense(FFN_RATIO * 2 * c, "mlp_0")(jnp.concatenate([x, message], axis=-1))
            message = norm("norm2")(dense(c, "mlp_2")(nn.gelu(hidden, approximate=False)))
        return x + message


class TransformerBlock(nn.Module):
    """Attention inside each view, then to the same window of its source views as they came in."""

    @nn.compact
    def __call__(self, windows, sources, together, allowed):
        v, n, cells, c = windows.shape
        context = windows[sources].transpose(0, 2, 1, 3, 4).reshape(v, n, sources.shape[1] * cells, c)
        windows = AttentionLayer(name="self_attn")(windows, windows, together)
        return AttentionLayer(has_ffn=True, name="cross_attn_ffn")(windows, context, allowed)


class Transformer(nn.Module):
    """Six blocks in windows of a part of the map, every other block shifted by half a window."""

    upstream_compat: bool

    @nn.compact
    def __call__(
        self, x: Float[Array, "v h w c"], sources: Int[Array, "v s"], source_valid: Bool[Array, "v s"]
    ) -> Float[Array, "v h w c"]:
        _, h, w, c = x.shape
        parts = num_splits(w)
        side = (h // parts, w // parts)
        x = x + jnp.tile(sine_positions(*side, c), (parts, parts, 1))
        cells = side[0] * side[1]
        for i in range(NUM_BLOCKS):
            shift = (side[0] // 2, side[1] // 2) if i % 2 else (0, 0)
            together = in_one_region(h, w, side, shift)
            seen = jnp.repeat(source_valid, cells, axis=1)[:, None, None]
            windows = to_windows(jnp.roll(x, (-shift[0], -shift[1]), axis=(1, 2)), side)
            allowed = seen & self.of_sources(together, sources.shape[1])
            windows = TransformerBlock(name=f"layers_{i}")(windows, sources, together, allowed)
            x = jnp.roll(from_windows(windows, side, h, w), shift, axis=(1, 2))
        return x

    def of_sources(self, together: Bool[Array, "1 n q k"], num_sources: int) -> Bool[Array, "1 n q sk"]:
        """Which keys of all sources a cell may attend to: those of its own region.

        Upstream lays the keys cell by cell and the mask source by source: of several sources, shifted windows attend
        across borders, to half of what they should. Its weights were trained so.
        """
        if not self.upstream_compat:
            return jnp.tile(together, num_sources)
        cells = together.shape[-1]
        source, cell = np.divmod(np.arange(num_sources * cells), cells)
        return together[..., (cell * num_sources + source) % cells]


def num_splits(width: int) -> int:
    """Windows along a side of a map: more of wide ones (ReSplat)."""
    return 2 if width <= 96 else 4 if width <= 192 else 8


class Encoder(nn.Module):
    """Images to the features of all three branches."""

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
    """Features of every view, informed by its source views."""
    sources, source_valid = nearest_sources(views.viewmats, views.valid, config.network.num_sources)
    return Encoder(config).apply({"params": params}, views.images, sources, source_valid)  # pyright: ignore[reportReturnType]
