"""Losses: rendering (Eq. training_loss) and, since procedural scenes know it, depth."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ssplat_jax.errors import InputError
from ssplat_jax.metrics.lpips import LpipsWeights, lpips
from ssplat_jax.metrics.psnr_ssim import SSIM_ARGUMENTS

LPIPS_WEIGHT = 0.05
"""Of LPIPS beside the MSE, as in the paper."""

NARROWEST_STEP = 1e-6
"""Of log depth between candidates: where near is far, there is nothing to divide by."""


def soft_targets(
    log_depths: Float[Array, "*b"], log_candidates: Float[Array, " d"], width: float = 0.6
) -> Float[Array, "*b d"]:
    """True depth as a narrow distribution over the candidates: a Gaussian of `width` steps between them, normalized.

    Limits:
        One candidate, or all at one depth: it is the whole distribution, or all alike.
    """
    # Candidates that are not uniform in log depth each have the step there.
    steps = jnp.abs(jnp.asarray(jnp.gradient(log_candidates))) if len(log_candidates) > 1 else jnp.zeros(1)
    step = jnp.maximum(steps, NARROWEST_STEP)
    return jax.nn.softmax(-0.5 * ((log_candidates - log_depths[..., None]) / (width * step)) ** 2, axis=-1)


def depth_loss(
    logits: Float[Array, "v hf wf d"],
    predicted: Float[Array, "v hf wf"],
    truth: Float[Array, "v hf wf"],
    log_candidates: Float[Array, " d"],
    usable: Bool[Array, "v hf wf"],
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Cross entropy of P_i and L1 of the anchored log depth, each a mean over usable cells with a depth in range.

    Limits:
        A true depth of 0 (unknown), infinite or NaN is out of range, and no part of value or gradient.
    """
    in_range = usable & (truth > log_candidates.min()) & (truth < log_candidates.max())
    truth = jnp.where(in_range, truth, jax.lax.stop_gradient(predicted))
    weight = in_range.astype(jnp.float32) / jnp.maximum(in_range.sum(), 1).astype(jnp.float32)
    targets = soft_targets(truth, log_candidates)
    entropy = -jnp.sum(targets * jax.nn.log_softmax(logits, axis=-1), axis=-1)
    return jnp.sum(weight * entropy), jnp.sum(weight * jnp.abs(predicted - truth))


def image_gradient_l1(a: Float[Array, "s h w 3"], b: Float[Array, "s h w 3"]) -> Float[Array, ""]:
    """Mean absolute difference of the horizontal and vertical pixel differences of two images."""
    difference = a - b
    horizontal = jnp.abs(difference[:, :, 1:] - difference[:, :, :-1]).mean()
    vertical = jnp.abs(difference[:, 1:] - difference[:, :-1]).mean()
    return horizontal + vertical


class RenderingLoss(NamedTuple):
    """Loss of rendered views and its parts."""

    total: Float[Array, ""]
    mse: Float[Array, ""]
    lpips: Float[Array, ""] | None  # None where no weights were given


def rendering_loss(
    images: Float[Array, "s h w 3"],
    targets: Float[Array, "s h w 3"],
    *,
    gradient_weight: float,
    lpips_weights: LpipsWeights | None = None,
) -> RenderingLoss:
    """MSE + 0.05 LPIPS (Eq. training_loss); without LPIPS weights, MSE and the L1 of image gradients."""
    mse = jnp.mean((images - targets) ** 2)
    if lpips_weights is None:
        return RenderingLoss(mse + gradient_weight * image_gradient_l1(images, targets), mse, None)
    distance = lpips(lpips_weights, images, targets).mean()
    return RenderingLoss(mse + LPIPS_WEIGHT * distance, mse, distance)


# -- SSIM (Wang et al. 2004), as scikit-image computes it with `SSIM_ARGUMENTS` ---------------------------------------

_SIDE = SSIM_ARGUMENTS["win_size"]
_GAUSSIAN = np.exp(-0.5 * ((np.arange(_SIDE) - _SIDE // 2) / 1.5) ** 2)
_TAPS = [float(tap) for tap in _GAUSSIAN / _GAUSSIAN.sum()]
_SAMPLE_COVARIANCE = _SIDE**2 / (_SIDE**2 - 1)
_C1, _C2 = 0.01**2, 0.03**2


def ssim(images: Float[Array, "*b h w 3"], targets: Float[Array, "*b h w 3"]) -> Float[Array, "*b"]:
    """Mean structural similarity over windows and channels, 1 for equal images: `metrics.ssim`, differentiable.

    Limits:
        Images in [0, 1], float32: within 1e-5 of `metrics.ssim`.
        Values outside [0, 1] are not clipped, so that the gradient brings them back.
        The gradient is finite everywhere, at constant images too, and 0 at equal ones.

    Raises:
        InputError: a side is below 11 pixels, the window's.
    """
    height, width = images.shape[-3:-1]
    if min(height, width) < _SIDE:
        raise InputError(f"ssim: wanted images of at least {_SIDE} pixels a side, got {width}x{height}.")
    mean_x, mean_y, var_x, var_y, cov = _window_moments(images, targets)
    luminance = (2 * mean_x * mean_y + _C1) / (mean_x**2 + mean_y**2 + _C1)
    structure = (2 * cov + _C2) / (var_x + var_y + _C2)
    return jnp.mean(luminance * structure, axis=(-3, -2, -1))


def _window_moments(x, y):
    """Means, variances and covariance in every whole window.

    First down the columns, then along the rows, each time around the mean just found, by the law of total covariance:
    E[xy] - E[x] E[y] loses to rounding, in float32, what `_C2` is compared with.
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
