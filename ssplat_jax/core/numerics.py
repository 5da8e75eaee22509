"""Numerically safe primitives, and the correlation of features with bilinearly sampled ones, which a plane sweep needs.

tests/stability/test_numerics.py tests every line of the primitives' limits.

Forward, the correlation of a depth is one kernel from the four samples to the score, so that only scores are written.
On a CPU, an einsum over gathered samples took four to eight times as long. Backward, it is linear in the source
features, so its gradient is two products with one sparse weight matrix. XLA's own transpose of the gather is a scatter
of feature rows, which on a CPU is seven times slower than everything else in the step.
"""

import functools
import math
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from ssplat_jax.core.cpu_backend import lane_sum
from ssplat_jax.core.pytree import pytree

Function = TypeVar("Function", bound=Callable[..., Any])


def power_of_two(number: int) -> int:
    """The least power of two that is at least `number`, 1 for none: capacities are few, and so are programs."""
    return 1 << max(number - 1, 0).bit_length()


def evenly_spread(count: int, most: int) -> list[int]:
    """At most `most` places (two or more) among `count`, evenly spread, the first and the last included."""
    if count <= most:
        return list(range(count))
    return [round(k * (count - 1) / (most - 1)) for k in range(most)]


def safe_normalize(x: Float[Array, "*s n"], eps: float = 1e-12) -> Float[Array, "*s n"]:
    """Unit vector along `x`.

    Limits:
        |x| <= eps gives zeros, and a zero (never NaN) gradient.
        float32: length within 4 ulp of 1 for 1e-10 < max|x| < 1e30 (the vector is scaled before it is squared).
    """
    largest = jnp.max(jnp.abs(x), axis=-1, keepdims=True)
    is_zero = largest <= eps
    scaled = jnp.where(is_zero, jnp.ones_like(x), x) / jnp.where(is_zero, jnp.ones_like(largest), largest)
    unit = scaled / jnp.sqrt(jnp.sum(scaled * scaled, axis=-1, keepdims=True))
    return jnp.where(is_zero, jnp.zeros_like(x), unit)


def columns(x: Float[Array, "*s n"]) -> tuple[Float[Array, "*s"], ...]:
    """The `n` entries along the last axis.

    They are split, not indexed: the gradient of a split is a concatenation, that of an index an array padded with
    zeros, `n` of which are then added.
    """
    return tuple(jnp.squeeze(column, axis=-1) for column in lax.split(x, (1,) * x.shape[-1], axis=-1))


def safe_log(x: Float[Array, "*s"], eps: float = 1e-12) -> Float[Array, "*s"]:
    """Natural logarithm.

    Limits:
        x <= eps gives log(eps), with a zero gradient.
    """
    is_small = x <= eps
    return jnp.where(is_small, jnp.log(jnp.asarray(eps, x.dtype)), jnp.log(jnp.where(is_small, jnp.ones_like(x), x)))


def safe_sqrt(x: Float[Array, "*s"]) -> Float[Array, "*s"]:
    """Square root.

    Limits:
        x <= 0 gives 0, with a zero gradient.
    """
    is_small = x <= 0
    return jnp.where(is_small, jnp.zeros_like(x), jnp.sqrt(jnp.where(is_small, jnp.ones_like(x), x)))


def clip_value(x: Float[Array, "*s"], low: float, high: float) -> Float[Array, "*s"]:
    """`x` clipped to [low, high], with the gradient of the identity.

    Limits:
        Beyond the bounds the gradient is 1 too: descent can come back. Inside, the value is `x` bit for bit.
    """
    return x + lax.stop_gradient(jnp.clip(x, low, high) - x)


def softplus_inverse(y: float) -> float:
    """The x with softplus(x) = y, for y > 0, in plain Python; for initial values."""
    return y + math.log(-math.expm1(-y))


def with_rank_promotion(function: Function) -> Function:
    """`function`, which broadcasts whatever `jax_numpy_rank_promotion` says to its caller's own code."""

    @functools.wraps(function)
    def promoting(*arguments, **options):
        with jax.numpy_rank_promotion("allow"):
            return function(*arguments, **options)

    return promoting  # pyright: ignore[reportReturnType]


# -- sampling ----------------------------------------------------------------------------------------------------------


@pytree
class BilinearTaps:
    """The four samples and the bilinear weights of every position at which a map is read."""

    corners: Int[Array, "*s"]  # flat index of the upper left sample
    right: Float[Array, "*s"]  # distance to the right of it, in [0, 1]
    down: Float[Array, "*s"]  # distance below it, in [0, 1]


def bilinear_taps(x: Float[Array, "*s"], y: Float[Array, "*s"], height: int, width: int) -> BilinearTaps:
    """Taps at positions in a `height` x `width` map.

    Args:
        x: columns in array indices: 0 is the center of the first sample.
        y: rows, likewise.
        height: rows of the map.
        width: columns of the map.

    Limits:
        Positions outside the map read the nearest border sample, NaN the first; callers mask them.
    """
    x = jnp.clip(jnp.nan_to_num(x), 0.0, width - 1.0)
    y = jnp.clip(jnp.nan_to_num(y), 0.0, height - 1.0)
    column, row = jnp.minimum(jnp.floor(x), max(width - 2, 0)), jnp.minimum(jnp.floor(y), max(height - 2, 0))
    corners = row.astype(jnp.int32) * width + column.astype(jnp.int32)
    return BilinearTaps(corners=corners, right=x - column, down=y - row)


def neighbor_offsets(height: int, width: int) -> tuple[int, int]:
    """Offsets of flat indices from a sample to its right and lower neighbors; 0 along a side of one sample."""
    return min(width - 1, 1), width if height > 1 else 0


@jax.custom_vjp
def correlate_warped(
    reference: Float[Array, "n c"], source: Float[Array, "h w c"], taps: BilinearTaps
) -> Float[Array, "d n"]:
    """Dot product of each reference feature with the source feature sampled at its taps.

    Args:
        reference: one feature per cell.
        source: the map that is sampled.
        taps: sampling positions `[d n]`, by depth candidate and cell.

    Returns:
        Scores by candidate and cell, differentiable in `reference` and `source`; taps are constants.
    """
    height, width, channels = source.shape
    samples = source.reshape(-1, channels)
    to_right, to_below = neighbor_offsets(height, width)

    def at_depth(taps):
        right, down = taps.right[:, None], taps.down[:, None]
        read = lambda offset: samples[taps.corners + offset]  # noqa: E731
        above = _lerp(read(0), read(to_right), right)
        below = _lerp(read(to_below), read(to_below + to_right), right)
        return lane_sum(reference * _lerp(above, below, down))

    return jax.lax.map(at_depth, taps)


def _lerp(a, b, weight):
    return a + weight * (b - a)


def _correlate_backward(residuals, cotangent):
    reference, source, taps = residuals
    height, width, channels = source.shape
    to_right, to_below = neighbor_offsets(height, width)
    corners, right, down = taps.corners, taps.right, taps.down
    indices = jnp.stack([corners, corners + to_right, corners + to_below, corners + to_below + to_right], axis=-1)
    weights = jnp.stack([(1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right], axis=-1)
    samples = source.reshape(-1, channels)
    rows = jnp.broadcast_to(jnp.arange(reference.shape[0])[None, :, None], indices.shape)
    mixing = jnp.zeros((reference.shape[0], samples.shape[0]), reference.dtype)
    mixing = mixing.at[rows, indices].add(cotangent[..., None] * weights)
    return mixing @ samples, (mixing.T @ reference).reshape(source.shape), None


correlate_warped.defvjp(lambda *inputs: (correlate_warped(*inputs), inputs), _correlate_backward)
