"""Sampling feature maps along other cameras' rays: the arithmetic of the plane sweep.

The correlation of a reference feature with a bilinearly warped source feature is linear in the source, so its backward
pass is two matrix products with one sparse weight matrix. XLA's own transpose of the gather is a scatter of whole
feature rows, which on a CPU is 7 x slower than everything else in the step.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int


def bilinear_taps(
    coords: Float[Array, "*s 2"], height: int, width: int
) -> tuple[Int[Array, "*s 4"], Float[Array, "*s 4"]]:
    """Flat indices and weights of the four samples around `coords`, in array index units (x, y), clamped to the border.

    Limits:
        Beyond the border, NaN included, the nearest border sample is read: callers mask what lies outside.
    """
    x = jnp.clip(jnp.nan_to_num(coords[..., 0]), 0.0, width - 1.0)
    y = jnp.clip(jnp.nan_to_num(coords[..., 1]), 0.0, height - 1.0)
    x0, y0 = jnp.floor(x), jnp.floor(y)
    fx, fy = x - x0, y - y0
    x0, y0 = x0.astype(jnp.int32), y0.astype(jnp.int32)
    x1, y1 = jnp.minimum(x0 + 1, width - 1), jnp.minimum(y0 + 1, height - 1)
    taps = jnp.stack([y0 * width + x0, y0 * width + x1, y1 * width + x0, y1 * width + x1], axis=-1)
    weights = jnp.stack([(1 - fy) * (1 - fx), (1 - fy) * fx, fy * (1 - fx), fy * fx], axis=-1)
    return taps, weights


@jax.custom_vjp
def correlate_warped(
    reference: Float[Array, "n c"],
    source: Float[Array, "s c"],
    taps: Int[Array, "d n 4"],
    weights: Float[Array, "d n 4"],
) -> Float[Array, "d n"]:
    """Dot products of `reference` with `source` resampled at `taps`.

    Entry (d, n) is sum_c reference[n, c] sum_t weights[d, n, t] source[taps[d, n, t], c].
    Differentiable in `reference` and `source`; the sampling positions are constants (ALGORITHM 2.6).
    """

    def at_depth(tap_weights):
        tap, weight = tap_weights
        return jnp.einsum("ntc,nt,nc->n", source[tap], weight, reference)

    return jax.lax.map(at_depth, (taps, weights))


def _correlate_forward(reference, source, taps, weights):
    return correlate_warped(reference, source, taps, weights), (reference, source, taps, weights)


def _correlate_backward(residuals, cotangent):
    reference, source, taps, weights = residuals
    rows = jnp.broadcast_to(jnp.arange(reference.shape[0])[None, :, None], taps.shape)
    mixing = jnp.zeros((reference.shape[0], source.shape[0]), reference.dtype)
    mixing = mixing.at[rows, taps].add(cotangent[..., None] * weights)
    return mixing @ source, mixing.T @ reference, None, None


correlate_warped.defvjp(_correlate_forward, _correlate_backward)
