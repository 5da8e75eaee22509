"""What to show where a scene lets light through: the colors around, by normalized convolution."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

SIGMA = 2.0  # pixels: half a cell of the streamed images
FAINT = 1e-3  # opacity everywhere of `beyond`, which shows where nothing else is near


def fill_holes(
    color: Float[Array, "*b h w 3"], alpha: Float[Array, "*b h w"], beyond: Float[Array, "3"], *, sigma: float = SIGMA
) -> Float[Array, "*b h w 3"]:
    """Premultiplied `color` over the blurred colors of what is around, over `beyond` where nothing is near.

        C + (1 - A) G(C + eps beyond) / G(A + eps)        G: a Gaussian of `sigma` pixels

    (Knutsson and Westin, Normalized and Differential Convolution, CVPR 1993.) Black, a color like any other, would
    make a hole the worst of errors, and half transparent surfaces dark.

    Limits:
        Alpha 1 everywhere: `color` itself. Alpha 0 for more than three sigma around: `beyond`. In between every value
        lies within the range of the colors C / A around and `beyond`; gradients are finite throughout.
    """
    radius = math.ceil(3 * sigma)
    taps = np.exp(-0.5 * (np.arange(-radius, radius + 1) / sigma) ** 2)
    weighted = jnp.concatenate([color + FAINT * beyond, alpha[..., None] + FAINT], axis=-1)
    for axis in (-3, -2):
        weighted = _blur(weighted, taps / taps.sum(), axis)
    return color + (1.0 - alpha)[..., None] * weighted[..., :3] / weighted[..., 3:]


def _blur(values: Float[Array, "*b h w c"], taps: np.ndarray, axis: int) -> Float[Array, "*b h w c"]:
    """Sums of neighbors along `axis`; nothing beyond the border."""
    radius, length = len(taps) // 2, values.shape[axis]
    padding = [(0, 0)] * values.ndim
    padding[axis % values.ndim] = (radius, radius)
    padded = jnp.pad(values, padding)
    take = lambda k: jax.lax.slice_in_dim(padded, k, k + length, axis=axis % values.ndim)  # noqa: E731
    return sum((float(t) * take(k) for k, t in enumerate(taps)), jnp.zeros_like(values))
