"""Layers that several stages share: convolutions, norms, attention, windows, and the small U-Net.

Norms and softmax are computed in float32.
"""

import functools
from collections.abc import Callable

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

# -- Convolutions -----------------------------------------------------------------------------------------------------

Pads = tuple[tuple[int, int], tuple[int, int]]  # zero padding ((top, bottom), (left, right))
DIMENSIONS = ("NHWC", "HWIO", "NHWC")


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def conv2d(x: Float[Array, "v h w c"], kernel: Float[Array, "kh kw c o"], pads: Pads) -> Float[Array, "v ho wo o"]:
    """Cross-correlation of `x`, zero-padded by `pads`, with `kernel` at stride 1.

    The backward pass is written out: the input gradient is a convolution with the flipped kernel, the kernel gradient
    one matrix product per tap. Inside a `lax.scan`, XLA's CPU backend computes kernel gradients with a generic
    algorithm (https://github.com/jax-ml/jax/issues/12868), 15 times slower.
    """
    return jax.lax.conv_general_dilated(x, kernel, (1, 1), pads, dimension_numbers=DIMENSIONS)


def _conv2d_backward(pads, residuals, cotangent):
    x, kernel = residuals
    kh, kw, c = kernel.shape[:3]
    flipped = jnp.flip(kernel, axis=(0, 1)).swapaxes(2, 3)
    (top, bottom), (left, right) = pads
    back_pads = ((kh - 1 - top, kh - 1 - bottom), (kw - 1 - left, kw - 1 - right))
    x_gradient = jax.lax.conv_general_dilated(cotangent, flipped, (1, 1), back_pads, dimension_numbers=DIMENSIONS)
    padded = jnp.pad(x, ((0, 0), *pads, (0, 0)))
    height, width = cotangent.shape[1:3]
    flat = cotangent.reshape(-1, cotangent.shape[-1])
    taps = [padded[:, i : i + height, j : j + width].reshape(-1, c).T @ flat for i in range(kh) for j in range(kw)]
    return x_gradient, jnp.stack(taps).reshape(kernel.shape)


conv2d.defvjp(lambda x, kernel, pads: (conv2d(x, kernel, pads), (x, kernel)), _conv2d_backward)


class Conv(nn.Module):
    """Convolution with an odd square kernel, stride 1 and symmetric padding, as in PyTorch. Keeps the size."""

    features: int
    kernel: int = 3
    use_bias: bool = True
    padding: str = "constant"  # of `jnp.pad`: zeros, or "edge"
    kernel_init: nn.initializers.Initializer = nn.initializers.lecun_normal()

    @nn.compact
    def __call__(self, x: Float[Array, "v h w c"]) -> Float[Array, "v h w o"]:
        kernel = self.param("kernel", self.kernel_init, (self.kernel, self.kernel, x.shape[-1], self.features))
        pad = self.kernel // 2
        if self.padding != "constant":
            x, pad = jnp.pad(x, ((0, 0), (pad, pad), (pad, pad), (0, 0)), mode=self.padding), 0
        y = conv2d(x, kernel, ((pad, pad), (pad, pad)))
        return y + self.param("bias", nn.initializers.zeros, (self.features,)) if self.use_bias else y  # pyright: ignore


class HalvingConv(nn.Module):
    """Convolution with an odd square kernel and stride 2, computed at stride 1 on 2 x 2 patches moved into channels.

    The parameter is the ordinary kernel. The gradient of a strided convolution is a dilated convolution, for which
    XLA's CPU backend has no fast path.
    """

    features: int
    kernel: int = 3
    use_bias: bool = True

    @nn.compact
    def __call__(self, x: Float[Array, "v h w c"]) -> Float[Array, "v hf wf o"]:
        c, reach = x.shape[-1], self.kernel // 2
        kernel = self.param("kernel", nn.initializers.lecun_normal(), (self.kernel, self.kernel, c, self.features))
        # Kernel offset o in [-reach, reach] is o = 2 m + r: tap m in [-before, reach // 2] of patch pixel r.
        before = (reach + 1) // 2
        taps = before + reach // 2 + 1
        front = 2 * before - reach
        back = 2 * taps - self.kernel - front
        kernel = jnp.pad(kernel, ((front, back), (front, back), (0, 0), (0, 0)))
        kernel = kernel.reshape(taps, 2, taps, 2, c, self.features).transpose(0, 2, 4, 1, 3, 5)
        kernel = kernel.reshape(taps, taps, 4 * c, self.features)
        pad = (before, taps - 1 - before)
        y = conv2d(pixel_unshuffle(x, 2), kernel, (pad, pad))
        return y + self.param("bias", nn.initializers.zeros, (self.features,)) if self.use_bias else y  # pyright: ignore


def pixel_unshuffle(x: Float[Array, "v h w c"], factor: int) -> Float[Array, "v hf wf cf"]:
    """Map with `factor` x `factor` patches moved into channels, in PyTorch's order (channel, row, column)."""
    v, h, w, c = x.shape
    x = x.reshape(v, h // factor, factor, w // factor, factor, c)
    return x.transpose(0, 1, 3, 5, 2, 4).reshape(v, h // factor, w // factor, c * factor * factor)


def pixel_shuffle(x: Float[Array, "v hf wf cf"], factor: int) -> Float[Array, "v h w c"]:
    """Inverse of `pixel_unshuffle`."""
    v, h, w, c = x.shape
    x = x.reshape(v, h, w, c // factor**2, factor, factor)
    return x.transpose(0, 1, 4, 2, 5, 3).reshape(v, h * factor, w * factor, c // factor**2)


# -- Norms and pooling ------------------------------------------------------------------------------------------------

IMAGE_MEAN, IMAGE_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # mean and standard deviation of ImageNet, RGB


def normalize_images(images: Float[Array, "v h w 3"]) -> Float[Array, "v h w 3"]:
    """Images in [0, 1] normalized by the statistics of ImageNet."""
    return (images - jnp.array(IMAGE_MEAN, images.dtype)) / jnp.array(IMAGE_STD, images.dtype)


def instance_norm(x: Float[Array, "v h w c"], eps: float = 1e-5) -> Float[Array, "v h w c"]:
    """Features with zero mean and unit variance per image and channel; no parameters.

    Limits:
        A constant channel gives zeros.
    """
    mean = jnp.mean(x, axis=(1, 2), keepdims=True)
    variance = jnp.mean((x - mean) ** 2, axis=(1, 2), keepdims=True)
    return (x - mean) * jax.lax.rsqrt(variance + eps)


def layer_norm(name: str, epsilon: float = 1e-5) -> nn.LayerNorm:
    """LayerNorm with PyTorch's epsilon and two-pass variance."""
    return nn.LayerNorm(epsilon=epsilon, use_fast_variance=False, name=name)


def average_pool(x: Float[Array, "v h w c"], factor: int) -> Float[Array, "v hf wf c"]:
    """Mean of `factor` x `factor` patches."""
    v, h, w, c = x.shape
    return x.reshape(v, h // factor, factor, w // factor, factor, c).mean(axis=(2, 4))


def rms_normalize(x: Float[Array, "*b c"], eps: float = 1e-6) -> Float[Array, "*b c"]:
    """Features scaled to a root mean square of 1.

    Limits:
        Zero gives zeros. Below an RMS of about 1e-3 the result shrinks with its input; gradients stay finite.
    """
    return x * jax.lax.rsqrt(jnp.mean(x * x, axis=-1, keepdims=True) + eps)


# -- Attention --------------------------------------------------------------------------------------------------------
def attend(
    queries: Float[Array, "*b q heads c"],
    keys: Float[Array, "*b k heads c"],
    values: Float[Array, "*b k heads c"],
    allowed: Bool[Array, "*#b #q k"] | None = None,
) -> Float[Array, "*b q heads c"]:
    """Scaled dot-product attention, softmax in float32.

    Limits:
        A query without an `allowed` key gives zeros.
    """
    # Heads come first because XLA's CPU backend multiplies matrices in that layout twice as fast.
    queries, keys, values = (jnp.moveaxis(x, -2, -3) for x in (queries, keys, values))
    scores = jnp.matmul(queries, jnp.swapaxes(keys, -1, -2)).astype(jnp.float32) * queries.shape[-1] ** -0.5
    if allowed is None:
        return jnp.moveaxis(jnp.matmul(jax.nn.softmax(scores, axis=-1).astype(values.dtype), values), -3, -2)
    allowed = allowed[..., None, :, :]
    weights = jax.nn.softmax(jnp.where(allowed, scores, -1e9), axis=-1)
    mixed = jnp.matmul(weights.astype(values.dtype), values)
    return jnp.moveaxis(mixed * jnp.any(allowed, axis=-1, keepdims=True).astype(mixed.dtype), -3, -2)


# -- Windows for attention (Swin Transformer, Liu et al. 2021) --------------------------------------------------------
def sine_positions(height: int, width: int, features: int) -> Float[np.ndarray, "h w c"]:
    """Sine position code of a window, normalized to 2 pi as in DETR: half of the channels for y, half for x."""
    half = features // 2
    rates = 10000.0 ** (2 * (np.arange(half) // 2) / half)

    def along(n):
        phases = (np.arange(n) + 1)[:, None] / n * 2 * np.pi / rates
        return np.where(np.arange(half) % 2 == 0, np.sin(phases), np.cos(phases)).astype(np.float32)

    shape = (height, width, half)
    rows, columns = along(height)[:, None], along(width)[None, :]
    return np.concatenate([np.broadcast_to(rows, shape), np.broadcast_to(columns, shape)], axis=-1)


def to_windows(x: Float[Array, "v h w c"], side: tuple[int, int]) -> Float[Array, "v windows cells c"]:
    """Map cut into windows of `side` = (height, width) cells."""
    v, h, w, c = x.shape
    x = x.reshape(v, h // side[0], side[0], w // side[1], side[1], c).transpose(0, 1, 3, 2, 4, 5)
    return x.reshape(v, (h // side[0]) * (w // side[1]), side[0] * side[1], c)


def from_windows(
    x: Float[Array, "v windows cells c"], side: tuple[int, int], height: int, width: int
) -> Float[Array, "v h w c"]:
    """Inverse of `to_windows`."""
    v, c = x.shape[0], x.shape[-1]
    x = x.reshape(v, height // side[0], width // side[1], *side, c).transpose(0, 1, 3, 2, 4, 5)
    return x.reshape(v, height, width, c)


def same_region_mask(
    height: int, width: int, side: tuple[int, int], shift: tuple[int, int]
) -> Bool[Array, "1 windows cells cells"]:
    """Pairs of cells in one window that may attend to each other, in a map rolled by `-shift`.

    Rolling brings cells from opposite borders of the map into one window; such pairs are False.
    """
    rows, columns = (np.arange(n) >= n - s for n, s in zip((height, width), shift, strict=True))
    regions = jnp.asarray((2 * rows[:, None] + columns)[None, :, :, None], jnp.float32)
    cells = to_windows(regions, side)[..., 0]
    return cells[..., :, None] == cells[..., None, :]


def attend_in_windows(
    x: Float[Array, "v h w c"],
    side: tuple[int, int],
    num_blocks: int,
    sources: Int[Array, "v s"],
    source_valid: Bool[Array, "v s"],
    block: Callable,
    repeat_mask: Callable = jnp.tile,
) -> Float[Array, "v h w c"]:
    """Features after blocks of attention in windows of `side` cells, each view to itself and to its source views.

    Every other block shifts the windows by half a window.

    Args:
        x: features of each view, without position code.
        side: (height, width) of a window.
        num_blocks: number of blocks.
        sources: indices of each view's source views.
        source_valid: which of them are valid.
        block: maps (number, windows, gather, together, allowed) to new windows. `gather(windows)` are the same windows
            of all sources, `together` masks cells of one region of the own window, `allowed` those of the sources'.
        repeat_mask: maps `together` and the number of sources to the mask of the sources' cells.
    """
    v, h, w, c = x.shape
    cells, num_sources = side[0] * side[1], sources.shape[1]
    x = x + jnp.tile(sine_positions(*side, c), (h // side[0], w // side[1], 1))
    seen = jnp.repeat(source_valid, cells, axis=1)[:, None, None]

    def gather(windows):
        return windows[sources].transpose(0, 2, 1, 3, 4).reshape(v, windows.shape[1], num_sources * cells, c)

    for i in range(num_blocks):
        shift = (side[0] // 2, side[1] // 2) if i % 2 else (0, 0)
        together = same_region_mask(h, w, side, shift)
        windows = to_windows(jnp.roll(x, (-shift[0], -shift[1]), axis=(1, 2)), side)
        windows = block(i, windows, gather, together, seen & repeat_mask(together, num_sources))
        x = jnp.roll(from_windows(windows, side, h, w), shift, axis=(1, 2))
    return x


class WindowAttention(nn.Module):
    """Residual one-head attention in windows, with an optional feed-forward layer on [input, message]."""

    ffn_ratio: int = 0  # of the feed-forward width to the feature width; 0 for no feed-forward layer
    names: tuple[str, ...] = ("q", "k", "v", "merge", "ffn1", "ffn2")  # of the parameters
    norm: Callable[..., nn.Module] = nn.LayerNorm

    @nn.compact
    def __call__(self, x, context, allowed):
        c = x.shape[-1]
        q, k, v, merge, ffn1, ffn2 = (functools.partial(nn.Dense, use_bias=False, name=name) for name in self.names)
        queries, keys, values = (y[..., None, :] for y in (q(c)(x), k(c)(context), v(c)(context)))
        message = self.norm(name="norm1")(merge(c)(attend(queries, keys, values, allowed)[..., 0, :]))
        if self.ffn_ratio:
            hidden = ffn1(self.ffn_ratio * c)(jnp.concatenate([x, message], axis=-1))
            message = self.norm(name="norm2")(ffn2(c)(nn.gelu(hidden, approximate=False)))
        return x + message


# -- Blocks, and the U-Net of the compact network and of CGFI ---------------------------------------------------------
class Mlp(nn.Module):
    """Two-layer MLP with a hidden layer four times as wide."""

    @nn.compact
    def __call__(self, x: Float[Array, "*b c"]) -> Float[Array, "*b c"]:
        c = x.shape[-1]
        return nn.Dense(c, name="fc2")(nn.gelu(nn.Dense(4 * c, name="fc1")(x), approximate=False))


class SelfAttention(nn.Module):
    """Self-attention among the tokens of each view."""

    heads: int
    use_bias: bool = True  # of queries, keys and values

    @nn.compact
    def __call__(self, x: Float[Array, "v n c"], allowed: Bool[Array, "1 1 n"] | None = None) -> Float[Array, "v n c"]:
        v, n, c = x.shape
        qkv = nn.Dense(3 * c, use_bias=self.use_bias, name="qkv")(x).reshape(v, n, 3, self.heads, c // self.heads)
        return nn.Dense(c, name="proj")(attend(qkv[:, :, 0], qkv[:, :, 1], qkv[:, :, 2], allowed).reshape(v, n, c))


class ResidualBlock(nn.Module):
    """Twice conv - InstanceNorm - ReLU, with a projected skip connection where the shape changes."""

    features: int
    stride: int = 1
    skip: str = "skip"
    """Parameter name of the projection."""

    @nn.compact
    def __call__(self, x):
        first = Conv if self.stride == 1 else HalvingConv
        y = nn.relu(instance_norm(first(self.features, use_bias=False, name="conv1")(x)))
        y = nn.relu(instance_norm(Conv(self.features, use_bias=False, name="conv2")(y)))
        if x.shape[-1] != self.features or self.stride != 1:
            # Projected before it is subsampled: XLA's GPU backend aborts on a product of subsampled pixels
            # (https://github.com/openxla/xla/issues/47381).
            projected = nn.Dense(self.features, name=self.skip)(x)
            x = instance_norm(projected[:, :: self.stride, :: self.stride])
        return nn.relu(x + y)


class UNetBlock(nn.Module):
    """Residual block: twice GroupNorm - SiLU - conv. The last convolution starts at zero."""

    features: int
    names: tuple[str, ...] = ("norm1", "conv1", "norm2", "conv2", "skip")  # of the parameters
    norm: Callable[..., nn.Module] = functools.partial(nn.GroupNorm, 8)

    @nn.compact
    def __call__(self, x):
        norm1, conv1, norm2, conv2, skip = self.names
        y = Conv(self.features, name=conv1)(nn.silu(self.norm(name=norm1)(x)))
        y = Conv(self.features, kernel_init=nn.initializers.zeros, name=conv2)(nn.silu(self.norm(name=norm2)(y)))
        return (x if x.shape[-1] == self.features else Conv(self.features, 1, name=skip)(x)) + y


class JointAttention(nn.Module):
    """Residual self-attention over the cells of all views of a chunk. The last layer starts at zero."""

    heads: int = 4

    @nn.compact
    def __call__(self, x, view_valid):
        v, h, w, c = x.shape
        qkv = nn.Dense(3 * c, name="qkv")(nn.GroupNorm(8, name="norm")(x)).reshape(1, v * h * w, 3, self.heads, -1)
        allowed = jnp.repeat(view_valid, h * w)[None, None]
        mixed = attend(qkv[:, :, 0], qkv[:, :, 1], qkv[:, :, 2], allowed).reshape(v, h, w, c)
        return x + nn.Dense(c, kernel_init=nn.initializers.zeros, name="out")(mixed)


class UNet(nn.Module):
    """U-Net of three levels with equal width, one block per level down and up, and joint attention at the lowest."""

    features: int

    @nn.compact
    def __call__(self, x, view_valid):
        skips = []
        for level in range(2):
            x = UNetBlock(self.features, name=f"down{level}")(x)
            skips.append(x)
            x = HalvingConv(self.features, name=f"shrink{level}")(x)
        x = UNetBlock(self.features, name="middle1")(x)
        x = JointAttention(name="attention")(x, view_valid)
        x = UNetBlock(self.features, name="middle2")(x)
        for level in (1, 0):
            x = jnp.repeat(jnp.repeat(x, 2, axis=1), 2, axis=2)
            x = Conv(self.features, name=f"grow{level}")(x)
            x = UNetBlock(self.features, name=f"up{level}")(jnp.concatenate([x, skips[level]], axis=-1))
        return x
