"""Layers that several stages share. Norms and softmax are computed in float32."""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ssplat_jax.core.xla_cpu import lane_sum
from ssplat_jax.model.convolution import Conv, HalvingConv

IMAGE_MEAN, IMAGE_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Mean and standard deviation of ImageNet, RGB."""


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


def average_pool(x: Float[Array, "v h w c"], factor: int) -> Float[Array, "v hf wf c"]:
    """Mean of `factor` x `factor` patches."""
    v, h, w, c = x.shape
    return x.reshape(v, h // factor, factor, w // factor, factor, c).mean(axis=(2, 4))


def attend(
    queries: Float[Array, "*b q heads c"],
    keys: Float[Array, "*b k heads c"],
    values: Float[Array, "*b k heads c"],
    allowed: Bool[Array, "*#b #q k"] | None = None,
) -> Float[Array, "*b q heads c"]:
    """Scaled dot-product attention, softmax in float32.

    Args:
        queries: query features.
        keys: key features.
        values: value features, one per key.
        allowed: which keys each query attends to; None for all.

    Limits:
        A query without an allowed key gives zeros.
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


def attend_per_query(
    queries: Float[Array, "m c"],
    keys: Float[Array, "m k c"],
    values: Float[Array, "m k c"],
    allowed: Bool[Array, "m k"],
) -> Float[Array, "m c"]:
    """One-head attention where every query has a few keys of its own.

    `attend` would compute products of one-row matrices, which are four times slower on a CPU.

    Args:
        queries: query features.
        keys: the k keys of each query.
        values: the values of those keys.
        allowed: which of its keys a query attends to.

    Limits:
        A query without an allowed key gives zeros.
    """
    scores = lane_sum(queries[:, None] * keys).astype(jnp.float32) * queries.shape[-1] ** -0.5
    weights = jax.nn.softmax(jnp.where(allowed, scores, -1e9), axis=-1) * allowed.astype(jnp.float32)
    return jnp.sum(weights.astype(values.dtype)[..., None] * values, axis=-2)


def rms_normalize(x: Float[Array, "*b c"], eps: float = 1e-6) -> Float[Array, "*b c"]:
    """Features scaled to a root mean square of 1.

    Limits:
        Zero gives zeros. Below an RMS of about 1e-3 the result shrinks with its input; gradients stay finite.
    """
    return x * jax.lax.rsqrt(jnp.mean(x * x, axis=-1, keepdims=True) + eps)


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

    @nn.compact
    def __call__(self, x):
        y = Conv(self.features, name="conv1")(nn.silu(nn.GroupNorm(8, name="norm1")(x)))
        y = nn.silu(nn.GroupNorm(8, name="norm2")(y))
        y = Conv(self.features, kernel_init=nn.initializers.zeros, name="conv2")(y)
        if x.shape[-1] != self.features:
            x = Conv(self.features, 1, name="skip")(x)
        return x + y


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
