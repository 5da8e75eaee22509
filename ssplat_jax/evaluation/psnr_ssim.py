"""PSNR and SSIM, computed on the host.

Images are RGB `[h w 3]`: floats in units of white, clipped to [0, 1], or uint8. SSIM depends on its window and weights,
so results are published with `SSIM_ARGUMENTS`.
"""

import math
from typing import Any

import numpy as np
from jaxtyping import Bool, Num
from skimage.metrics import structural_similarity

from ssplat_jax.core.errors import InputError, refusal

MIN_MSE = 1e-10
"""Lower bound of the mean squared error: PSNR is at most 100 dB, a finite number that JSON can hold."""

BRIGHT = 4.0
"""An image of which half the values are above this is in other units, as 0 to 255."""

SSIM_ARGUMENTS: dict[str, Any] = {"win_size": 11, "gaussian_weights": True, "data_range": 1.0, "channel_axis": -1}
"""Arguments of scikit-image's `structural_similarity`; its Gaussian has a standard deviation of 1.5 pixels."""


def psnr(
    image: Num[np.ndarray, "_ _ 3"], target: Num[np.ndarray, "_ _ 3"], seen: Bool[np.ndarray, "_ _"] | None = None
) -> float:
    """Peak signal-to-noise ratio in dB, over all channels of the pixels `seen`, by default of all pixels.

    Limits:
        Equal images give 100 dB (`MIN_MSE`); NaN gives NaN, and so does no pixel.

    Raises:
        InputError: the images differ in size, have no pixels, or are neither floats in units of white nor uint8.
    """
    image, target = _checked(image, target, 1)
    if seen is not None:
        image, target = image[seen], target[seen]
        if not len(image):
            return math.nan
    return float(-10 * np.log10(np.maximum(np.mean((image - target) ** 2), MIN_MSE)))


def ssim(
    image: Num[np.ndarray, "_ _ 3"], target: Num[np.ndarray, "_ _ 3"], seen: Bool[np.ndarray, "_ _"] | None = None
) -> float:
    """Mean structural similarity over channels and the pixels `seen`, by default all pixels; 1 for equal images.

    Pixels that are not seen are equal in the windows of those that are.

    Limits:
        NaN gives NaN.

    Raises:
        InputError: as `psnr`, or a side is shorter than the window, 11 pixels.
    """
    image, target = _checked(image, target, SSIM_ARGUMENTS["win_size"])
    if seen is not None:
        image = np.where(seen[..., None], image, target)
        similarities = structural_similarity(image, target, full=True, **SSIM_ARGUMENTS)[1]
        return float(np.mean(similarities[seen])) if seen.any() else math.nan
    return float(structural_similarity(image, target, **SSIM_ARGUMENTS))  # pyright: ignore[reportArgumentType]


def _checked(image, target, min_side: int):
    """Both images in float64, clipped to [0, 1]."""
    if image.shape != target.shape:
        raise InputError(f"metrics: wanted two images of one size, got {image.shape} and {target.shape}; resize one.")
    if min(image.shape[:2]) < min_side:
        raise InputError(
            f"metrics: wanted images of at least {min_side} pixels a side, got {image.shape[1]}x{image.shape[0]}; "
            "render larger ones."
        )
    return _in_units_of_white(image), _in_units_of_white(target)


def _in_units_of_white(image: np.ndarray) -> np.ndarray:
    """An image in float64, clipped to [0, 1]; a rendered one may exceed white here and there, but not in half of it."""
    if image.dtype == np.uint8:
        return image / 255.0
    if not np.issubdtype(image.dtype, np.floating) or np.mean(image > BRIGHT) > 0.5:
        got, fix = f"{image.dtype} from {image.min()} to {image.max()}", "divide by the value of white"
        raise refusal("metrics: image", wanted="floats in [0, 1], or uint8", got=got, fix=fix)
    return np.clip(image.astype(np.float64), 0.0, 1.0)
