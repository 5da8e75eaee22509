"""Image encoder: a CNN, then windowed self-attention and cross-view attention (as in DepthSplat)."""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ssplat_jax.config import StreamConfig
from ssplat_jax.model.compact.compact_layers import AttentionLayer, CompactFeatures
from ssplat_jax.model.layers import (
    Conv,
    HalvingConv,
    ResidualBlock,
    from_windows,
    instance_norm,
    normalize_images,
    same_region_mask,
    sine_positions,
    to_windows,
)
from ssplat_jax.model.views import Views, nearest_sources


class Encoder(nn.Module):
    """Maps images to matching features at 1/2 and 1/4 and context features at 1/4."""

    config: StreamConfig

    def setup(self):
        fine, grid = self.config.network.encoder_widths
        blocks = range(self.config.network.encoder_blocks)
        self.stem = HalvingConv(fine, 7, use_bias=False)
        self.fine_blocks = [ResidualBlock(fine) for _ in blocks]
        self.grid_blocks = [ResidualBlock(grid, stride=2 if i == 0 else 1) for i in blocks]
        self.project = Conv(grid, 1)
        self.self_attention = [AttentionLayer() for _ in range(self.config.network.attention_blocks)]
        self.cross_attention = [
            AttentionLayer(self.config.network.attention_ffn) for _ in range(self.config.network.attention_blocks)
        ]
        self.match_fine = Conv(self.config.network.match_width, 1)
        self.match_grid = Conv(self.config.network.match_width, 1)

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
        return CompactFeatures(
            fine=self.match_fine(fine),
            grid=self.match_grid(attended),
            context=jnp.concatenate([cnn, attended], axis=-1),
        )

    def attend_views(self, cnn, sources, source_valid):
        """CNN features after alternating attention within each view and to the same window of its source views.

        Every other pair of layers shifts the windows by half a window.
        """
        side = self.config.network.attention_window
        v, h, w, c = cnn.shape
        window = (side, side)
        x = cnn + jnp.tile(sine_positions(*window, c), (h // side, w // side, 1))
        num_sources = sources.shape[1]
        for i, (own, cross) in enumerate(zip(self.self_attention, self.cross_attention, strict=True)):
            shift = side // 2 if i % 2 else 0
            windows = to_windows(jnp.roll(x, (-shift, -shift), axis=(1, 2)), window)
            together = same_region_mask(h, w, window, (shift, shift))
            windows = own(windows, windows, together)
            context = windows[sources].transpose(0, 2, 1, 3, 4).reshape(v, windows.shape[1], num_sources * side**2, c)
            allowed = jnp.repeat(source_valid, side**2, axis=1)[:, None, None] & jnp.tile(together, num_sources)
            windows = cross(windows, context, allowed)
            x = jnp.roll(from_windows(windows, window, h, w), (shift, shift), axis=(1, 2))
        return x


def encode(params, views: Views, config: StreamConfig) -> CompactFeatures:
    """Features of each view, with attention to its source views."""
    sources, source_valid = nearest_sources(views.viewmats, views.valid, config.network.num_sources)
    return Encoder(config).apply({"params": params}, views.images, sources, source_valid)  # pyright: ignore[reportReturnType]
