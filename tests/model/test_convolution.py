"""The fast convolutions equal plain ones, forward and backward, also inside a scan."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.model.layers import DIMENSIONS, Conv, HalvingConv, conv2d, pixel_unshuffle

FLOAT32 = 2e-4  # sums of a few hundred products of unit normals, in another order


def normal(seed, *shape):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


def plain(x, kernel, pads):
    return jax.lax.conv_general_dilated(x, kernel, (1, 1), pads, dimension_numbers=DIMENSIONS)


def check_same_gradients(f, g, *arguments):
    """Values of two functions, and their pullbacks of one random cotangent."""
    (a, pull_a), (b, pull_b) = jax.vjp(f, *arguments), jax.vjp(g, *arguments)
    np.testing.assert_allclose(a, b, atol=FLOAT32)
    cotangent = normal(99, *a.shape)
    for x, y in zip(jax.tree.leaves(pull_a(cotangent)), jax.tree.leaves(pull_b(cotangent)), strict=True):
        np.testing.assert_allclose(x, y, atol=FLOAT32)


@pytest.mark.parametrize(
    ("size", "pads"),
    [((1, 1), ((0, 0), (0, 0))), ((3, 3), ((1, 1), (1, 1))), ((4, 2), ((2, 1), (0, 1))), ((3, 5), ((0, 2), (3, 0)))],
)
def test_conv2d_is_the_convolution_forward_and_backward(size, pads):
    x, kernel = normal(0, 2, 6, 7, 3), normal(1, *size, 3, 5)
    check_same_gradients(lambda x, k: conv2d(x, k, pads), lambda x, k: plain(x, k, pads), x, kernel)


def test_conv2d_in_a_scan_has_the_gradients_of_the_plain_one():
    x, kernel, pads = normal(2, 1, 5, 6, 4), 0.3 * normal(3, 3, 3, 4, 4), ((1, 1), (1, 1))

    def scanned(x, kernel):
        return jax.lax.scan(lambda c, _: (jnp.tanh(conv2d(c, kernel, pads)), None), x, length=3)[0]

    def unrolled(x, kernel):
        for _ in range(3):
            x = jnp.tanh(plain(x, kernel, pads))
        return x

    check_same_gradients(jax.jit(scanned), jax.jit(unrolled), x, kernel)


@pytest.mark.parametrize(
    ("module", "stride", "size"), [(Conv, 1, 1), (Conv, 1, 5), *((HalvingConv, 2, size) for size in (1, 3, 5, 7))]
)
def test_a_convolution_is_that_of_flax_with_the_same_parameters(module, stride, size):
    x, ours = normal(7, 2, 8, 10, 3), module(4, size)
    theirs = nn.Conv(4, (size, size), strides=stride, padding=size // 2)
    params = {"kernel": normal(8, size, size, 3, 4), "bias": normal(9, 4)}
    apply = lambda module: lambda p, x: module.apply({"params": p}, x)  # noqa: E731
    check_same_gradients(apply(ours), apply(theirs), params, x)


def test_pixel_unshuffle_has_pytorch_channel_order():
    x = np.arange(2 * 4 * 6 * 3, dtype=np.float32).reshape(2, 4, 6, 3)
    got = pixel_unshuffle(jnp.asarray(x), 2)
    assert got.shape == (2, 2, 3, 12)
    for channel, row, column in np.ndindex(3, 2, 2):
        np.testing.assert_array_equal(got[..., channel * 4 + row * 2 + column], x[:, row::2, column::2, channel])
