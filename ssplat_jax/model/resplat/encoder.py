"""Image encoder: a CNN, a multi-view transformer and a vision transformer (as in DepthSplat)."""

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ssplat_jax.config import StreamConfig
from ssplat_jax.model.layers import (
    Conv,
    HalvingConv,
    Mlp,
    ResidualBlock,
    SelfAttention,
    WindowAttention,
    attend_in_windows,
    instance_norm,
    layer_norm,
    normalize_images,
)
from ssplat_jax.model.resplat.torch_layers import ReSplatFeatures, resize
from ssplat_jax.model.views import Views, nearest_sources

WIDTHS = (64, 96, 128)  # channels of the three CNN levels
NUM_BLOCKS = 6  # blocks of the multi-view transformer
FFN_RATIO = 8  # of the feed-forward width to the feature width
PIXELS_PER_VIT_CELL = 14  # side of a patch
POSITIONS_SIDE = 37  # cells per side of the trained position code, which is resampled to other grids
MAX_SIDE = 560  # longer side, in pixels, to which larger images are resized
CUBIC_A = -0.75  # parameter of PyTorch's bicubic kernel; JAX's is -0.5

VITS = {
    # width, blocks, heads, indices of the blocks whose maps are returned
    "s": (384, 12, 6, (2, 5, 8, 11)),
    "b": (768, 12, 12, (2, 5, 8, 11)),
    "l": (1024, 24, 16, (4, 11, 17, 23)),
}
"""Layout by size of the vision transformer."""


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


class TransformerBlock(nn.Module):
    """Attention within each view, then to the same window of its source views as they entered the block."""

    @nn.compact
    def __call__(self, windows, gather, together, allowed):
        context = gather(windows)
        names = ("q_proj", "k_proj", "v_proj", "merge", "mlp_0", "mlp_2")
        windows = WindowAttention(0, names, layer_norm, name="self_attn")(windows, windows, together)
        return WindowAttention(FFN_RATIO, names, layer_norm, name="cross_attn_ffn")(windows, context, allowed)


class Transformer(nn.Module):
    """Six blocks of windowed attention."""

    upstream_compat: bool

    @nn.compact
    def __call__(
        self, x: Float[Array, "v h w c"], sources: Int[Array, "v s"], source_valid: Bool[Array, "v s"]
    ) -> Float[Array, "v h w c"]:
        parts = 2 if x.shape[2] <= 96 else 4 if x.shape[2] <= 192 else 8  # windows along each side: ReSplat's rule
        side = (x.shape[1] // parts, x.shape[2] // parts)
        block = lambda i, *given: TransformerBlock(name=f"layers_{i}")(*given)  # noqa: E731
        return attend_in_windows(x, side, NUM_BLOCKS, sources, source_valid, block, self.source_mask)

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


# -- Monocular branch: a DINOv2 vision transformer, as trained by Depth Anything V2 -----------------------------------
def grid_size(height: int, width: int) -> tuple[int, int]:
    """Rows and columns of ViT cells for an image of that size."""
    scale = min(1.0, MAX_SIDE / max(height, width))
    cells = lambda side: max(1, int(side * scale) // PIXELS_PER_VIT_CELL)  # noqa: E731
    return cells(height), cells(width)


def resampled_positions(codes: Float[Array, "1 n c"], height: int, width: int) -> Float[Array, "1 m c"]:
    """Position code resampled to a grid of `height` x `width` cells, without the class token's.

    DINOv2 gives PyTorch the scale factor (size + 0.1) / 37 instead of the size; sample positions follow the factor.
    """
    if (height, width) == (POSITIONS_SIDE, POSITIONS_SIDE):
        return codes[:, 1:]
    rows, columns = _cubic_weights(height), _cubic_weights(width)
    grid = codes[0, 1:].reshape(POSITIONS_SIDE, POSITIONS_SIDE, -1)
    return jnp.einsum("ph,hwc,qw->pqc", rows, grid, columns, precision="highest").reshape(1, height * width, -1)


def _cubic_weights(size: int) -> np.ndarray:
    """Bicubic weights of the trained samples along one axis for `size` resampled ones, with edge padding."""
    positions = (np.arange(size) + 0.5) * POSITIONS_SIDE / (size + 0.1) - 0.5
    weights = np.zeros((size, POSITIONS_SIDE), np.float32)
    for tap in range(-1, 3):
        sample = np.floor(positions) + tap
        t = np.abs(positions - sample)
        inner = (CUBIC_A + 2) * t**3 - (CUBIC_A + 3) * t**2 + 1
        outer = CUBIC_A * (t**3 - 5 * t**2 + 8 * t - 4)
        column = np.clip(sample, 0, POSITIONS_SIDE - 1).astype(int)
        np.add.at(weights, (np.arange(size), column), np.where(t <= 1, inner, outer))
    return weights


class LayerScale(nn.Module):
    """Learned factor per channel."""

    @nn.compact
    def __call__(self, x: Float[Array, "*b c"]) -> Float[Array, "*b c"]:
        return x * self.param("gamma", nn.initializers.constant(1e-5), (x.shape[-1],))  # pyright: ignore


class Block(nn.Module):
    """Pre-norm transformer block."""

    heads: int

    @nn.compact
    def __call__(self, x: Float[Array, "v n c"]) -> Float[Array, "v n c"]:
        norm = lambda name: layer_norm(name, epsilon=1e-6)  # noqa: E731
        x = x + LayerScale(name="ls1")(SelfAttention(self.heads, name="attn")(norm("norm1")(x)))
        return x + LayerScale(name="ls2")(Mlp(name="mlp")(norm("norm2")(x)))


class PatchEmbed(nn.Module):
    """Projection of each 14 x 14 patch to a token."""

    features: int

    @nn.compact
    def __call__(self, images: Float[Array, "v h w 3"]) -> Float[Array, "v n c"]:
        side = PIXELS_PER_VIT_CELL
        conv = nn.Conv(self.features, (side, side), strides=(side, side), padding="VALID", name="proj")
        return conv(images).reshape(images.shape[0], -1, self.features)


class VisionTransformer(nn.Module):
    """Maps normalized images to the outputs of four blocks."""

    size: str

    @nn.compact
    def __call__(self, images: Float[Array, "v h w 3"]) -> tuple[Float[Array, "v hp wp c"], ...]:
        width, num_blocks, heads, read = VITS[self.size]
        rows, columns = grid_size(*images.shape[1:3])
        small = resize(images, rows * PIXELS_PER_VIT_CELL, columns * PIXELS_PER_VIT_CELL)
        start = nn.initializers.normal(0.02)
        class_token = self.param("cls_token", start, (1, 1, width))
        codes = self.param("pos_embed", start, (1, 1 + POSITIONS_SIDE**2, width))
        x = PatchEmbed(width, name="patch_embed")(small) + resampled_positions(codes, rows, columns)  # pyright: ignore
        first = jnp.broadcast_to(class_token + codes[:, :1], (x.shape[0], 1, width))  # pyright: ignore
        x = jnp.concatenate([first, x], axis=1)
        norm = layer_norm("norm", epsilon=1e-6)
        maps = []
        for i in range(num_blocks):
            x = Block(heads, name=f"blocks_{i}")(x)
            if i in read:
                maps.append(norm(x)[:, 1:].reshape(-1, rows, columns, width))
        return tuple(maps)


# -- All branches -----------------------------------------------------------------------------------------------------
class ReSplatEncoder(nn.Module):
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
    return ReSplatEncoder(config).apply({"params": params}, views.images, sources, source_valid)  # pyright: ignore[reportReturnType]
