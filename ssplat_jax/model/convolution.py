"""Convolutions with gradients that are fast inside `lax.scan` on a CPU.

Inside a loop, XLA's CPU backend computes kernel gradients with a generic algorithm
(https://github.com/jax-ml/jax/issues/12868), 15 times slower than outside. Here the backward pass is written out: the
input gradient is a convolution with the flipped kernel, the kernel gradient one matrix product per tap.
"""

import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Pads = tuple[tuple[int, int], tuple[int, int]]
"""Zero padding ((top, bottom), (left, right))."""
DIMENSIONS = ("NHWC", "HWIO", "NHWC")


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def conv2d(x: Float[Array, "v h w c"], kernel: Float[Array, "kh kw c o"], pads: Pads) -> Float[Array, "v ho wo o"]:
    """Cross-correlation of `x`, zero-padded by `pads`, with `kernel` at stride 1."""
    return jax.lax.conv_general_dilated(x, kernel, (1, 1), pads, dimension_numbers=DIMENSIONS)


def _conv2d_forward(x, kernel, pads):
    return conv2d(x, kernel, pads), (x, kernel)


def _conv2d_backward(pads, residuals, cotangent):
    x, kernel = residuals
    kh, kw = kernel.shape[:2]
    flipped = jnp.flip(kernel, axis=(0, 1)).swapaxes(2, 3)
    (top, bottom), (left, right) = pads
    back_pads = ((kh - 1 - top, kh - 1 - bottom), (kw - 1 - left, kw - 1 - right))
    x_gradient = jax.lax.conv_general_dilated(cotangent, flipped, (1, 1), back_pads, dimension_numbers=DIMENSIONS)
    padded = jnp.pad(x, ((0, 0), *pads, (0, 0)))
    height, width = cotangent.shape[1:3]
    flat = cotangent.reshape(-1, cotangent.shape[-1])
    taps = [
        padded[:, i : i + height, j : j + width].reshape(-1, x.shape[-1]).T @ flat for i in range(kh) for j in range(kw)
    ]
    return x_gradient, jnp.stack(taps).reshape(kernel.shape)


conv2d.defvjp(_conv2d_forward, _conv2d_backward)


class Conv(nn.Module):
    """Convolution with an odd square kernel, stride 1 and symmetric zero padding, as in PyTorch. Keeps the size."""

    features: int
    kernel: int = 3
    use_bias: bool = True
    kernel_init: nn.initializers.Initializer = nn.initializers.lecun_normal()

    @nn.compact
    def __call__(self, x: Float[Array, "v h w c"]) -> Float[Array, "v h w o"]:
        kernel = self.param("kernel", self.kernel_init, (self.kernel, self.kernel, x.shape[-1], self.features))
        pad = self.kernel // 2
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
