"""Import of the weights that ReSplat published, as parameters of `network="resplat"`.

Parameters have the names of their PyTorch modules, so a rule maps one name to the other:

    encoder/backbone/layer1_0/conv1/kernel      encoder.depth_predictor.backbone.layer1.0.conv1.weight
    mixer/blocks_0/attn/qkv/kernel              encoder.pt.blocks.0.attn.qkv.weight

Files of the depth network alone lack the prefix `encoder.depth_predictor.`; a file of Depth Anything V2 provides only
`pretrained.`. Parameters that the file does not have keep their initial values, always including those of HPDA and
CGFI, which ReSplat does not have.
"""

import re
from collections.abc import Callable
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

PARTS = (
    *(f"{DEPTH}{part}." for part in ("backbone", "transformer", "pretrained", "upsampler")),
    (f"{DEPTH}regressor.", f"{DEPTH}regressor_residual.", f"{DEPTH}depth_head."),
    ("encoder.gaussian_regressor.", "encoder.proj."),
    "encoder.pt.",
    "encoder.gaussian_head.",
)
"""Prefixes of the parts of the network; a file must have all tensors of a part or none."""


class PublishedTensor(NamedTuple):
    """PyTorch tensor that a parameter is imported from."""

    name: str
    shape: tuple[int, ...]
    to_parameter: Callable[[np.ndarray], np.ndarray]
    """Converts the tensor to the layout of the parameter."""


class ImportedParams(NamedTuple):
    """Imported parameters and what the file provided."""

    params: dict
    num_imported: int
    num_unused: int
    initialized_parts: tuple[str, ...]
    """Parts that the file does not have, each named by its first module."""


def published_tensor(path: tuple[str, ...], shape: tuple[int, ...]) -> PublishedTensor | None:
    """Returns the PyTorch tensor of the parameter at `path`, or None if ReSplat has no such tensor."""
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
    """Returns the PyTorch tensor, or None, of every parameter of a model with `config`, by the parameter's path."""
    wanted = jax.eval_shape(lambda key: init_params(key, config), jax.random.key(0))
    leaves = jax.tree_util.tree_flatten_with_path(wanted)[0]
    return {"/".join(k.key for k in keys): published_tensor(tuple(k.key for k in keys), x.shape) for keys, x in leaves}


def as_published(config: StreamConfig) -> StreamConfig:
    """`config` with the behavior of the code that the published weights were trained with.

    That code reads depth in the space of the candidates (`depth_readout="mean"`), where the paper prints metric depths.
    """
    return config.replace(upstream_compat=True, depth_readout="mean")


def import_params(path: Path, config: StreamConfig, seed: int = 0, *, depth_only: bool = False) -> ImportedParams:
    """Imports parameters from a `.safetensors` or `.npz` file that has PyTorch's names.

    Args:
        path: the file.
        config: configuration of a model with ReSplat's network.
        seed: seed of the parameters that the file does not have.
        depth_only: import the depth network only, as from a checkpoint of DepthSplat, whose later stages differ.

    Returns:
        The parameters and what the file provided.

    Raises:
        InputError: `config` has another network, or the file is of another kind, is damaged, has no tensors of this
            network, has only some tensors of a part, or has tensors of other shapes.
    """
    if config.network.kind != "resplat":
        raise InputError(
            f"import-weights: wanted a preset of ReSplat's network (paper, small, base), got {config.preset!r}."
        )
    in_file = read_tensors(path)
    # A depth network on its own is saved without the prefix of the model around it.
    missing_prefix = "" if any(name.startswith("encoder.") for name in in_file) else DEPTH
    tensors_by_place = published_tensors(config)
    tensors = {place: t for place, t in tensors_by_place.items() if t is not None}
    names_in_file = {t.name: t.name.removeprefix(missing_prefix) for t in tensors.values()}
    wanted = {name for name in names_in_file if name.startswith(DEPTH) or not depth_only}
    available = {name for name, there in names_in_file.items() if name in wanted and there in in_file}
    initialized_parts = _initialized_parts(path, names_in_file, available)
    if not available:
        raise InputError(
            f"{path}: wanted weights of ReSplat, its depth network or Depth Anything V2; the file has none of their"
            f" {len(tensors)} tensors."
        )
    shapes = {names_in_file[t.name]: t.shape for t in tensors.values() if t.name in available}
    check_tensors(path, in_file, shapes)
    incomplete = {p.partition("/")[0] for p, t in tensors_by_place.items() if t is None or t.name not in available}
    key = jax.random.key(seed)
    stages = jax.eval_shape(lambda: init_params(key, config))  # those without parameters too
    params = {name: {} for name in stages} | init_params(key, config, incomplete)
    for place, tensor in tensors.items():
        if tensor.name in available:
            _insert(params, place, jnp.asarray(tensor.to_parameter(in_file[names_in_file[tensor.name]])))
    return ImportedParams(params, len(shapes), len(in_file) - len(shapes), initialized_parts)


def _initialized_parts(path: Path, names_in_file: dict[str, str], available: set[str]) -> tuple[str, ...]:
    """Parts that the file does not have; a part of which it has only some tensors is refused."""
    initialized = []
    for part in PARTS:
        of_part = [name for name in names_in_file if name.startswith(part)]
        absent = [name for name in of_part if name not in available]
        if 0 < len(absent) < len(of_part):
            missing = names_in_file[absent[0]]
            raise InputError(f"{path}: wanted an array {missing}, the file has none; is it another network's?")
        if absent:
            first = part if isinstance(part, str) else part[0]
            initialized.append(first.removeprefix(DEPTH).removeprefix("encoder.").strip("."))
    return tuple(initialized)


def _insert(params: dict, place: str, value: jax.Array) -> None:
    """Sets the parameter at the path `place`, such as `encoder/backbone/conv1/kernel`."""
    *folders, leaf = place.split("/")
    for name in folders:
        params = params.setdefault(name, {})
    params[leaf] = value
