"""LPIPS, the learned perceptual distance (Zhang et al. 2018), version 0.1 on VGG16, as PyTorch's `lpips` computes it.

The trained weights cannot be shipped. The user provides torchvision's `vgg16` and the package's heads (`vgg.pth`), both
as `.safetensors` or `.npz` under the same names.

    image in [0, 1] -> [-1, 1] -> shift and scale -> VGG16 -> relu1_2, relu2_2, relu3_3, relu4_3, relu5_3
    per layer: features of unit length per pixel, squared difference, head's weights over channels, mean over pixels
"""

import functools
from pathlib import Path

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ssplat_jax.core.errors import InputError
from ssplat_jax.core.pytree import pytree
from ssplat_jax.storage.files import check_tensors, read_tensors

MIN_SIDE = 16
"""Smallest side of an image in pixels, of which four halvings leave one for the last layer."""

# Constants of the package, on which its trained heads depend.
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)
_NORM_EPS = 1e-10

# Indices of the convolutions in torchvision's `vgg16().features`, and their output channels. The last layer of each
# line is compared; a 2 x 2 maximum leads to the next line.
_STAGES = (
    ((0, 64), (2, 64)),
    ((5, 128), (7, 128)),
    ((10, 256), (12, 256), (14, 256)),
    ((17, 512), (19, 512), (21, 512)),
    ((24, 512), (26, 512), (28, 512)),
)


@pytree
class LpipsWeights:
    """Convolutions of VGG16 in order, and the heads: a weight per channel of the five compared layers."""

    kernels: tuple[Float[Array, "3 3 _ _"], ...]  # height, width, channels in, channels out
    biases: tuple[Float[Array, " _"], ...]
    heads: tuple[Float[Array, " _"], ...]


def load_lpips(vgg_path: Path, heads_path: Path) -> LpipsWeights:
    """LPIPS weights from two files.

    Args:
        vgg_path: torchvision's `vgg16` state dict; only the names `features.*` are read.
        heads_path: heads of the `lpips` package for VGG16 (`lin0.model.1.weight` to `lin4`).

    Raises:
        InputError: a file cannot be read, lacks an array, or has one of another shape or with non-finite values.
    """
    shapes, channels_in = {}, 3
    for i, channels_out in (layer for stage in _STAGES for layer in stage):
        shapes[f"features.{i}.weight"] = (channels_out, channels_in, 3, 3)
        shapes[f"features.{i}.bias"] = (channels_out,)
        channels_in = channels_out
    head_shapes = {f"lin{k}.model.1.weight": (1, stage[-1][1], 1, 1) for k, stage in enumerate(_STAGES)}
    vgg, heads = read_tensors(vgg_path), read_tensors(heads_path)
    check_tensors(vgg_path, vgg, shapes)
    check_tensors(heads_path, heads, head_shapes)
    return LpipsWeights(
        kernels=tuple(jnp.asarray(vgg[name]).transpose(2, 3, 1, 0) for name in shapes if name.endswith("weight")),
        biases=tuple(jnp.asarray(vgg[name]) for name in shapes if name.endswith("bias")),
        heads=tuple(jnp.asarray(heads[name]).reshape(-1) for name in head_shapes),
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
    for stage in _STAGES:
        if outputs:
            x = jax.lax.reduce_window(x, -jnp.inf, jax.lax.max, (1, 2, 2, 1), (1, 2, 2, 1), "VALID")
        for kernel, bias in (next(layers) for _ in stage):
            x = jax.nn.relu(convolve(x, kernel) + bias)
        outputs.append(x)
    return outputs


def _unit_features(x: Float[Array, "b _ _ c"]) -> Float[Array, "b _ _ c"]:
    """Features of unit length; zeros stay zeros with a zero gradient, where that of a square root is infinite."""
    squares = jnp.sum(x * x, axis=-1, keepdims=True)
    is_off = squares == 0
    length = jnp.where(is_off, 0.0, jnp.sqrt(jnp.where(is_off, 1.0, squares)))
    return x / (length + _NORM_EPS)
