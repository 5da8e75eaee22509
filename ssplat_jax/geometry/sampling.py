"""Sampling feature maps along other cameras' rays: the arithmetic of the plane sweep.

Forward, one depth at a time, everything from the four samples to the products is one kernel that writes only scores: on
a CPU an einsum of the gathered samples took four to eight times as long.

The correlation of a reference feature with a bilinearly warped source feature is linear in the source, so its backward
pass is two matrix products with one sparse weight matrix. XLA's own transpose of the gather is a scatter of whole
feature rows, which on a CPU is 7 x slower than everything else in the step.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ssplat_jax.pytree import pytree
from ssplat_jax.xla_cpu import lane_sum


@pytree
class Places:
    """Where a map is read: between a sample, its neighbors to the right and below, and the one across."""

    corners: Int[Array, "*s"]  # flat index of the sample up and to the left
    right: Float[Array, "*s"]  # how far right of it, in [0, 1]
    down: Float[Array, "*s"]


def places_of(x: Float[Array, "*s"], y: Float[Array, "*s"], height: int, width: int) -> Places:
    """Places at coordinates in array index units, clamped to the border of a `height` x `width` map.

    Limits:
        Beyond the border, NaN included, the nearest border sample is read: callers mask what lies outside.
    """
    x = jnp.clip(jnp.nan_to_num(x), 0.0, width - 1.0)
    y = jnp.clip(jnp.nan_to_num(y), 0.0, height - 1.0)
    column, row = jnp.minimum(jnp.floor(x), max(width - 2, 0)), jnp.minimum(jnp.floor(y), max(height - 2, 0))
    corners = row.astype(jnp.int32) * width + column.astype(jnp.int32)
    return Places(corners=corners, right=x - column, down=y - row)


def neighbors(height: int, width: int) -> tuple[int, int]:
    """Steps from a sample's flat index to the one on its right and the one below; 0 where a map has but one."""
    return min(width - 1, 1), width if height > 1 else 0


@jax.custom_vjp
def correlate_warped(
    reference: Float[Array, "n c"], source: Float[Array, "h w c"], places: Places
) -> Float[Array, "d n"]:
    """Dot products of `reference` with `source` read between its samples at `places` `[d n]`.

    Differentiable in `reference` and `source`; the places are constants (ALGORITHM 2.6).
    """
    height, width, channels = source.shape
    samples = source.reshape(-1, channels)
    to_right, to_below = neighbors(height, width)

    def at_depth(places):
        right, down = places.right[:, None], places.down[:, None]
        read = lambda step: samples[places.corners + step]  # noqa: E731
        above = _between(read(0), read(to_right), right)
        below = _between(read(to_below), read(to_below + to_right), right)
        return lane_sum(reference * _between(above, below, down))

    return jax.lax.map(at_depth, places)


def _between(a, b, share):
    return a + share * (b - a)


def _correlate_forward(reference, source, places):
    return correlate_warped(reference, source, places), (reference, source, places)


def _correlate_backward(residuals, cotangent):
    reference, source, places = residuals
    height, width, channels = source.shape
    to_right, to_below = neighbors(height, width)
    corners, right, down = places.corners, places.right, places.down
    taps = jnp.stack([corners, corners + to_right, corners + to_below, corners + to_below + to_right], axis=-1)
    weights = jnp.stack([(1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right], axis=-1)
    samples = source.reshape(-1, channels)
    rows = jnp.broadcast_to(jnp.arange(reference.shape[0])[None, :, None], taps.shape)
    mixing = jnp.zeros((reference.shape[0], samples.shape[0]), reference.dtype)
    mixing = mixing.at[rows, taps].add(cotangent[..., None] * weights)
    return mixing @ samples, (mixing.T @ reference).reshape(source.shape), None


correlate_warped.defvjp(_correlate_forward, _correlate_backward)
