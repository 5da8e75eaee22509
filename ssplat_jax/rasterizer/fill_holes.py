"""Hole filling: where a scene lets light through, the colors around, by normalized convolution."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

SIGMA = 2.0
"""Standard deviation of the blur, pixels: half a cell of the streamed images."""

BACKGROUND_WEIGHT = 1e-3
"""Opacity that the background has everywhere: it shows where nothing else is near."""


def fill_holes(
    color: Float[Array, "*b h w 3"],
    alpha: Float[Array, "*b h w"],
    background: Float[Array, "3"],
    *,
    sigma: float = SIGMA,
) -> Float[Array, "*b h w 3"]:
    """Rendered images with the blurred colors of the surroundings behind them, instead of black.

        C + (1 - A) G(C + eps background) / G(A + eps)        G: a Gaussian of `sigma` pixels

    (Knutsson and Westin, Normalized and Differential Convolution, CVPR 1993.) Over black, a hole would be as wrong as
    it can be, and half transparent surfaces would be dark.

    Args:
        color: RGB premultiplied by alpha, as `render` returns it without a background.
        alpha: 1 - transmittance.
        background: RGB to show where nothing is near.
        sigma: standard deviation of the blur, pixels.

    Returns:
        Opaque RGB.

    Limits:
        Alpha 1 everywhere: `color` itself. Alpha 0 for more than three sigma around: `background`. In between, every
        value is within the range of the surrounding colors C / A and `background`; gradients are finite throughout.
    """
    radius = math.ceil(3 * sigma)
    taps = np.exp(-0.5 * (np.arange(-radius, radius + 1) / sigma) ** 2)
    weighted = jnp.concatenate([color + BACKGROUND_WEIGHT * background, alpha[..., None] + BACKGROUND_WEIGHT], axis=-1)
    for axis in (-3, -2):
        weighted = _blur(weighted, taps / taps.sum(), axis)
    return color + (1.0 - alpha)[..., None] * weighted[..., :3] / weighted[..., 3:]


def _blur(values: Float[Array, "*b h w c"], taps: np.ndarray, axis: int) -> Float[Array, "*b h w c"]:
    """Weighted sums of neighbors along `axis`; zero outside the border."""
    radius, length = len(taps) // 2, values.shape[axis]
    padding = [(0, 0)] * values.ndim
    padding[axis % values.ndim] = (radius, radius)
    padded = jnp.pad(values, padding)
    take = lambda k: jax.lax.slice_in_dim(padded, k, k + length, axis=axis % values.ndim)  # noqa: E731
    return sum((float(t) * take(k) for k, t in enumerate(taps)), jnp.zeros_like(values))
