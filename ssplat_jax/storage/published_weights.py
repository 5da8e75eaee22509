"""Import of the weights that ReSplat published, as parameters of `network="resplat"`.

Parameters have the names of their PyTorch modules, so a rule maps one name to the other:

    encoder/backbone/layer1_0/conv1/kernel      encoder.depth_predictor.backbone.layer1.0.conv1.weight
    mixer/blocks_0/attn/qkv/kernel              encoder.pt.blocks.0.attn.qkv.weight

Files of the depth network alone lack the prefix `encoder.depth_predictor.`; a file of Depth Anything V2 provides only
`pretrained.`. Parameters that the file does not have keep their initial values, always including those of HPDA and
CGFI, which ReSplat does not have.
"""

import functools
import re
from collections.abc import Callable, Collection
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ssplat_jax.config import StreamConfig
from ssplat_jax.core.errors import InputError
from ssplat_jax.model.network import init_params
from ssplat_jax.storage.files import check_tensors, read_tensors

DEPTH = "encoder.depth_predictor."
"""Prefix of the depth network's tensors."""

PREFIXES = {
    "encoder": DEPTH,
    "cost_volume": DEPTH,
    "upsampler": f"{DEPTH}upsampler.",
    "tokens": "encoder.",
    "mixer": "encoder.pt.",
    "decoder": "encoder.",
}
"""Prefix of the PyTorch names by the first module of a parameter's path."""


class PublishedTensor(NamedTuple):
    """PyTorch tensor that a parameter is imported from."""

    name: str
    shape: tuple[int, ...]
    to_parameter: Callable[[np.ndarray], np.ndarray]  # from the tensor's layout to the parameter's


class ImportedParams(NamedTuple):
    """Imported parameters and what the file provided."""

    params: dict
    num_imported: int
    num_unused: int
    initialized_parts: list[str]  # of which the file has nothing, such as `encoder/pretrained` or `mixer`


def published_tensor(path: tuple[str, ...], shape: tuple[int, ...]) -> PublishedTensor | None:
    """The PyTorch tensor of the parameter at `path`, or None if ReSplat has no such tensor."""
    if path[0] not in PREFIXES:
        return None
    *modules, leaf = path[1:]
    words = [re.sub(r"_(\d+)", r".\1", module) for module in modules]
    name = PREFIXES[path[0]] + ".".join([*words, {"kernel": "weight", "scale": "weight"}.get(leaf, leaf)])
    if leaf != "kernel":
        return PublishedTensor(name, shape, lambda x: x)
    if len(shape) == 2:
        # PyTorch has convolutions with one tap for some linear layers: in the U-Net's attention and the CNN's skips.
        taps = (1,) if path[0] == "cost_volume" else (1, 1) if "downsample" in name else ()
        return PublishedTensor(name, (*shape[::-1], *taps), lambda x: x.reshape(x.shape[:2]).T)
    height, width, channels, features = shape
    if "resize_layers.0" in name or "resize_layers.1" in name:  # transposed convolutions
        return PublishedTensor(name, (channels, features, height, width), lambda x: x.transpose(2, 3, 0, 1))
    return PublishedTensor(name, (features, channels, height, width), lambda x: x.transpose(2, 3, 1, 0))


def published_tensors(config: StreamConfig) -> dict[str, PublishedTensor | None]:
    """The PyTorch tensor, or None, of every parameter of a model with `config`, by the parameter's path."""
    wanted = jax.eval_shape(lambda key: init_params(key, config), jax.random.key(0))
    paths = [(tuple(k.key for k in keys), x.shape) for keys, x in jax.tree_util.tree_flatten_with_path(wanted)[0]]
    return {"/".join(path): published_tensor(path, shape) for path, shape in paths}


def as_published(config: StreamConfig) -> StreamConfig:
    """`config` with the behavior of the code that the published weights were trained with.

    That code reads depth in the space of the candidates (`depth_readout="mean"`), where the paper prints metric depths.
    """
    return config.replace(upstream_compat=True, depth_readout="mean")


def import_params(path: Path, config: StreamConfig, *, depth_only: bool = False) -> ImportedParams:
    """Imports parameters from a `.safetensors` or `.npz` file that has PyTorch's names.

    Args:
        path: the file.
        config: configuration of a model with ReSplat's network.
        depth_only: import the depth network only, as from a checkpoint of DepthSplat, whose later stages differ.

    Raises:
        InputError: `config` has another network, or the file is of another kind, is damaged, has no tensors of this
            network, has only some tensors of a part, or has tensors of other shapes.
    """
    if config.network.kind != "resplat":
        raise InputError(
            f"import-weights: wanted a preset of ReSplat's network (paper, small, base), got {config.preset!r}."
        )
    found = read_tensors(path)
    if not any(name.startswith("encoder.") for name in found):  # a depth network without the model around it
        found = {DEPTH + name: x for name, x in found.items()}
    by_place = published_tensors(config)
    shapes = {t.name: t.shape for t in by_place.values() if t is not None}
    usable = {name: shapes[name] for name in shapes if name in found and (name.startswith(DEPTH) or not depth_only)}
    initialized_parts = _initialized_parts(path, by_place, usable)
    if not usable:
        raise InputError(
            f"{path}: wanted weights of ReSplat, its depth network or Depth Anything V2; the file has none of their"
            f" {len(shapes)} tensors."
        )
    check_tensors(path, found, usable)
    incomplete = {place.partition("/")[0] for place, t in by_place.items() if t is None or t.name not in usable}
    fresh = init_params(jax.random.key(0), config, incomplete)

    def parameter(keys, _):
        tensor = by_place["/".join(k.key for k in keys)]
        if tensor is not None and tensor.name in usable:
            return jnp.asarray(tensor.to_parameter(found[tensor.name]))
        return functools.reduce(lambda tree, k: tree[k.key], keys, fresh)

    stages = jax.eval_shape(lambda key: init_params(key, config), jax.random.key(0))
    params = jax.tree_util.tree_map_with_path(parameter, stages)
    return ImportedParams(params, len(usable), len(found) - len(usable), initialized_parts)


def _initialized_parts(path: Path, tensors: dict[str, PublishedTensor | None], usable: Collection[str]) -> list[str]:
    """Parts of the network of which the file has nothing; a part of which it has only some tensors is refused."""
    parts: dict[str, list[str]] = {}
    for place, tensor in tensors.items():
        if tensor is not None:
            part = "/".join(place.split("/")[: 2 if place.startswith("encoder/") else 1])
            parts.setdefault(part, []).append(tensor.name)
    for names in parts.values():
        absent = [name for name in names if name not in usable]
        if 0 < len(absent) < len(names):
            raise InputError(f"{path}: wanted an array {absent[0]}, the file has none; is it another network's?")
    return [part for part, names in parts.items() if names[0] not in usable]
