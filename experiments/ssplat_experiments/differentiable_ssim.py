"""SSIM (Wang et al. 2004) in JAX, differentiable, as scikit-image computes it with `SSIM_ARGUMENTS`."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ssplat_jax.core.errors import InputError
from ssplat_jax.evaluation.psnr_ssim import SSIM_ARGUMENTS

_SIDE = SSIM_ARGUMENTS["win_size"]
_GAUSSIAN = np.exp(-0.5 * ((np.arange(_SIDE) - _SIDE // 2) / 1.5) ** 2)
_TAPS = [float(tap) for tap in _GAUSSIAN / _GAUSSIAN.sum()]
_SAMPLE_COVARIANCE = _SIDE**2 / (_SIDE**2 - 1)
_C1, _C2 = 0.01**2, 0.03**2


def ssim(images: Float[Array, "*b h w 3"], targets: Float[Array, "*b h w 3"]) -> Float[Array, "*b"]:
    """Mean structural similarity over windows and channels; 1 for equal images.

    Limits:
        Within 1e-5 of `psnr_ssim.ssim` for float32 images in [0, 1].
        Values outside [0, 1] are not clipped, so that they get a gradient.
        The gradient is finite everywhere, also at constant images, and 0 at equal images.

    Raises:
        InputError: a side is shorter than the window, 11 pixels.
    """
    height, width = images.shape[-3:-1]
    if min(height, width) < _SIDE:
        raise InputError(f"ssim: wanted images of at least {_SIDE} pixels a side, got {width}x{height}.")
    mean_x, mean_y, var_x, var_y, cov = _window_moments(images, targets)
    luminance = (2 * mean_x * mean_y + _C1) / (mean_x**2 + mean_y**2 + _C1)
    structure = (2 * cov + _C2) / (var_x + var_y + _C2)
    return jnp.mean(luminance * structure, axis=(-3, -2, -1))


def _window_moments(x, y):
    """Means, variances and covariance in every window inside the image.

    Computed along columns and then along rows, by the law of total covariance. In float32, rounding errors of
    E[xy] - E[x] E[y] would be as large as `_C2`.
    """
    mean_x, mean_y = x, y
    var_x = var_y = cov = jnp.zeros_like(x)
    for axis in (x.ndim - 3, x.ndim - 2):
        xs, ys = _shifted(mean_x, axis), _shifted(mean_y, axis)
        mean_x, mean_y = _weighted(xs), _weighted(ys)
        off_x, off_y = [z - mean_x for z in xs], [z - mean_y for z in ys]
        var_x = _weighted(_shifted(var_x, axis)) + _weighted([d * d for d in off_x])
        var_y = _weighted(_shifted(var_y, axis)) + _weighted([d * d for d in off_y])
        cov = _weighted(_shifted(cov, axis)) + _weighted([dx * dy for dx, dy in zip(off_x, off_y, strict=True)])
    return mean_x, mean_y, *(_SAMPLE_COVARIANCE * z for z in (var_x, var_y, cov))


def _shifted(x, axis: int) -> list:
    count = x.shape[axis] - _SIDE + 1
    return [jax.lax.slice_in_dim(x, k, k + count, axis=axis) for k in range(_SIDE)]


def _weighted(shifted: list):
    return sum(tap * z for tap, z in zip(_TAPS, shifted, strict=True))
