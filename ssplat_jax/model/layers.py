"""Building blocks that several stages share. Norms and softmax are float32 whatever the features' dtype."""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ssplat_jax.model.convolution import Conv, HalvingConv
from ssplat_jax.numerics import safe_normalize
from ssplat_jax.xla_cpu import lane_sum

IMAGE_MEAN = (0.485, 0.456, 0.406)  # ImageNet, as DepthSplat
IMAGE_STD = (0.229, 0.224, 0.225)


def normalize_images(images: Float[Array, "v h w 3"]) -> Float[Array, "v h w 3"]:
    """Images in [0, 1] as the networks take them."""
    return (images - jnp.array(IMAGE_MEAN, images.dtype)) / jnp.array(IMAGE_STD, images.dtype)


def instance_norm(x: Float[Array, "v h w c"], eps: float = 1e-5) -> Float[Array, "v h w c"]:
    """Zero mean, unit (biased) variance per image and channel; no parameters.

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
    """Scaled dot-product attention of each query to the keys that it is allowed, softmax in float32.

    Limits:
        No allowed key gives zeros.
    """
    # Heads first, since XLA's CPU backend multiplies matrices that lie so twice as fast.
    queries, keys, values = (jnp.moveaxis(x, -2, -3) for x in (queries, keys, values))
    scores = jnp.matmul(queries, jnp.swapaxes(keys, -1, -2)).astype(jnp.float32) * queries.shape[-1] ** -0.5
    if allowed is None:
        return jnp.moveaxis(jnp.matmul(jax.nn.softmax(scores, axis=-1).astype(values.dtype), values), -3, -2)
    allowed = allowed[..., None, :, :]
    weights = jax.nn.softmax(jnp.where(allowed, scores, -1e9), axis=-1)
    mixed = jnp.matmul(weights.astype(values.dtype), values)
    return jnp.moveaxis(mixed * jnp.any(allowed, axis=-1, keepdims=True).astype(mixed.dtype), -3, -2)


def attend_own(
    queries: Float[Array, "m c"],
    keys: Float[Array, "m k c"],
    values: Float[Array, "m k c"],
    allowed: Bool[Array, "m k"],
) -> Float[Array, "m c"]:
    """`attend` with one head, of queries that have a few keys each to themselves.

    Matrix products of one row would be four times as slow on a CPU.

    Limits:
        No allowed key gives zeros.
    """
    scores = lane_sum(queries[:, None] * keys).astype(jnp.float32) * queries.shape[-1] ** -0.5
    weights = jax.nn.softmax(jnp.where(allowed, scores, -1e9), axis=-1) * allowed.astype(jnp.float32)
    return jnp.sum(weights.astype(values.dtype)[..., None] * values, axis=-2)


def unit_features(x: Float[Array, "*b c"]) -> Float[Array, "*b c"]:
    """Features on the unit sphere, so that a dot product is a cosine (zero stays zero)."""
    return safe_normalize(x, eps=1e-6)


def rms_normalize(x: Float[Array, "*b c"], eps: float = 1e-6) -> Float[Array, "*b c"]:
    """Features scaled to a root mean square of 1.

    Limits:
        Zero gives zeros; below an RMS of about 1e-3 the result shrinks with its input, and gradients stay finite.
    """
    return x * jax.lax.rsqrt(jnp.mean(x * x, axis=-1, keepdims=True) + eps)


class ResidualBlock(nn.Module):
    """conv - InstanceNorm - ReLU twice, with a projected skip where the shape changes (ALGORITHM 2.2)."""

    features: int
    stride: int = 1
    skip: str = "skip"
    """Name of the projection."""

    @nn.compact
    def __call__(self, x):
        first = Conv if self.stride == 1 else HalvingConv
        y = nn.relu(instance_norm(first(self.features, use_bias=False, name="conv1")(x)))
        y = nn.relu(instance_norm(Conv(self.features, use_bias=False, name="conv2")(y)))
        if x.shape[-1] != self.features or self.stride != 1:
            x = instance_norm(nn.Dense(self.features, name=self.skip)(x[:, :: self.stride, :: self.stride]))
        return nn.relu(x + y)


class UNetBlock(nn.Module):
    """GroupNorm - SiLU - conv twice; the last convolution starts at zero (ALGORITHM 2.7)."""

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
    """Self-attention over the cells of all views of the chunk together, residual, last layer zero-initialized."""

    heads: int = 4

    @nn.compact
    def __call__(self, x, view_valid):
        v, h, w, c = x.shape
        qkv = nn.Dense(3 * c, name="qkv")(nn.GroupNorm(8, name="norm")(x)).reshape(1, v * h * w, 3, self.heads, -1)
        allowed = jnp.repeat(view_valid, h * w)[None, None]
        mixed = attend(qkv[:, :, 0], qkv[:, :, 1], qkv[:, :, 2], allowed).reshape(v, h, w, c)
        return x + nn.Dense(c, kernel_init=nn.initializers.zeros, name="out")(mixed)


class UNet(nn.Module):
    """Three levels of equal width, one block a level on the way down and up, joint attention at the lowest."""

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
