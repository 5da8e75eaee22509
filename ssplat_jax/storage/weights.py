"""Weights files: parameters by path (`encoder/conv1/kernel`), stored as float16 or float32 and loaded as float32.

Those that ReSplat published are imported as parameters of `network="resplat"`. Parameters have the names of their
PyTorch modules, so a rule maps one name to the other:

    encoder/backbone/layer1_0/conv1/kernel      encoder.depth_predictor.backbone.layer1.0.conv1.weight
    mixer/blocks_0/attn/qkv/kernel              encoder.pt.blocks.0.attn.qkv.weight

Files of the depth network alone lack the prefix `encoder.depth_predictor.`; a file of Depth Anything V2 provides only
`pretrained.`. Parameters that the file does not have keep their initial values, always including those of HPDA and
CGFI, which ReSplat does not have.
"""

import dataclasses
import functools
import hashlib
import re
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import traverse_util
from jax.flatten_util import ravel_pytree

from ssplat_jax.config import PRESETS, PUBLISHED, StreamConfig, preset
from ssplat_jax.core.errors import InputError, StorageError
from ssplat_jax.model.network import init_params, stages_of
from ssplat_jax.storage.files import load_arrays, read_tensors, save_arrays

KIND = "weights 1"

SHIPPED = Path(__file__).parents[1] / "weights"
"""Folder of the weights that ship with presets: 3 MB, because nothing is downloaded at install time. Every clone keeps
each replacement, so they are replaced only when scores move."""


def save_weights(
    path: Path, params: dict, config: StreamConfig, provenance: dict, dtype: type[np.floating] = np.float16
) -> None:
    """Writes the parameters of a model and its configuration to a weights file.

    Args:
        path: the file to write.
        params: parameters, as nested dicts.
        config: the configuration of the model.
        provenance: JSON-serializable facts about the training (steps, data, scores).
        dtype: type of the parameters on disk; float16 halves the file, imported weights keep their float32.

    Raises:
        StorageError: a value is not finite or too large for `dtype`, or the file cannot be written.
    """
    leaves = _by_path(params)
    with np.errstate(over="ignore"):  # values that overflow become infinite and are refused below
        arrays = {name: np.asarray(leaf, dtype) for name, leaf in leaves.items()}
    if bad := [name for name, x in arrays.items() if not np.isfinite(x).all()]:
        raise StorageError(f"{path}: {bad[0]} has values beyond {np.dtype(dtype)} or not finite; not saved.")
    save_arrays(path, arrays, KIND, {"config": config.to_dict(), "provenance": provenance})


@dataclasses.dataclass(frozen=True)
class WeightsFacts:
    """A weights file without its parameters."""

    config: StreamConfig
    provenance: dict  # JSON facts about the training, as `save_weights` got them
    num_bytes: int  # of the file


def load_weights(path: Path) -> tuple[dict, StreamConfig]:
    """(params, config) of a weights file, whose parameters must have the shapes of its configuration."""
    arrays, facts = _read(path)
    return _restore(path, arrays, facts.config), facts.config


def describe_weights(name: str) -> WeightsFacts:
    """Facts about the weights that ship with the preset `name`, or about the weights file `name`."""
    return _read(_path_of(name))[1]


def load_params(name: str = "tiny") -> dict:
    """Trained parameters: those shipped with the preset `name`, or those of the weights file `name`.

    Raises:
        InputError: there is no such preset or file, no weights ship with the preset, or the shapes do not match.
        StorageError: the file is damaged.
    """
    path = _path_of(name)
    arrays, facts = _read(path)
    config = preset(name) if name in PRESETS else facts.config
    shapes = None
    if path.parent == SHIPPED and config == facts.config:  # a test compares the shapes
        empty = {name: {} for name in stages_of(config)}  # some stages need no parameters
        shapes = empty | traverse_util.unflatten_dict(arrays, sep="/")
    return _restore(path, arrays, config, shapes)


def _path_of(name: str) -> Path:
    """The file of the weights `name`; see `load_params`."""
    file = SHIPPED / f"{name}.npz" if name in PRESETS else Path(name)
    if file.is_file():
        return file
    if name in PRESETS:
        fix = f"convert ReSplat's (ssplat import-weights) or train (ssplat train --preset {name}), and give the file"
        raise InputError(f"weights: none ship with the preset {name!r}; {fix}.")
    known = ", ".join(preset for preset in sorted(PRESETS) if (SHIPPED / f"{preset}.npz").is_file())
    raise InputError(f"weights: wanted a preset with shipped weights ({known}) or a file, got {name!r}.")


def _read(path: Path) -> tuple[dict[str, np.ndarray], WeightsFacts]:
    arrays, header = load_arrays(path, KIND)
    config = StreamConfig.from_dict(header["config"])
    return arrays, WeightsFacts(config, header["provenance"], path.stat().st_size)


def trainings(provenance: dict) -> list[dict]:
    """The provenance of each training, or import, that led to weights, the first one first."""
    before = provenance.get("before")
    return [*(trainings(before) if isinstance(before, dict) else ()), provenance]


def changed_shares(params: dict, facts: WeightsFacts) -> dict[str, float]:
    """Share of each stage's parameters that training changed: of their norm, the part that is not along their start.

    It is the sine of the angle between the parameters and their random start: weight decay alone shortens them, and has
    the share 0.

    Limits:
        Stages without parameters are left out. A stage that starts at zero has 0 if it stayed there, else 1.
    """
    start: dict = {}
    for training in trainings(facts.provenance):
        recipe = training.get("recipe")  # a text where several recipes were run
        seed = recipe.get("seed", 0) if isinstance(recipe, dict) else 0
        # A later training began with the stages of the one before, and drew only those that were missing.
        fresh = training.get("fresh", ()) if start else None
        start |= init_params(jax.random.key(seed), facts.config, only=fresh)
    shares = {}
    for stage, part in start.items():
        if jax.tree.leaves(part):
            before, after = (np.asarray(ravel_pytree(x)[0], np.float64) for x in (part, params[stage]))
            # `after` without its part along the start: 1 - cos^2 would cancel for small angles.
            across = after - (after @ before) / max(before @ before, 1e-300) * before
            shares[stage] = float(np.linalg.norm(across) / max(np.linalg.norm(after), 1e-300))
    return shares


def params_digest(params: Any) -> str:
    """Digest of a tree of parameters (12 hex digits), which identifies them in saved states."""
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(params):  # jax.tree traverses dicts in the order of their keys
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()[:12]


def check_params(params: dict, config: StreamConfig, origin: str) -> None:
    """Checks that `params` has the parameters of a model with `config`; additional ones are allowed.

    Raises:
        InputError: a parameter is missing or has another shape; the message names `origin`, the source of `params`.
    """
    _restore(origin, _by_path(params), config)


def _by_path(params: dict) -> dict[str, Any]:
    """Leaves of the parameter tree by their path, such as `encoder/conv1/kernel`."""
    return {"/".join(k.key for k in keys): leaf for keys, leaf in jax.tree_util.tree_flatten_with_path(params)[0]}


def _restore(path: Path | str, arrays: Mapping[str, Any], config: StreamConfig, shapes: dict | None = None) -> dict:
    """Builds the parameter tree of a model with `config` from arrays by path, and checks their shapes.

    `shapes` is the tree of the shapes of such a model, where it is known.
    """

    def leaf(keys, shape):
        name = "/".join(k.key for k in keys)
        if name not in arrays or arrays[name].shape != shape.shape:
            came = arrays[name].shape if name in arrays else "nothing"
            why = "the weights belong to another configuration"
            raise InputError(f"{path}: {name} must be {shape.shape}, got {came}; {why}.")
        return jax.device_put(np.asarray(arrays[name], np.float32))  # jnp.asarray compiles a program for each shape

    return jax.tree_util.tree_map_with_path(leaf, _shapes(config) if shapes is None else shapes)


@functools.lru_cache(maxsize=8)  # tracing a network takes a second
def _shapes(config: StreamConfig) -> dict:
    return jax.eval_shape(lambda: init_params(jax.random.key(0), config))


# -- weights of ReSplat ------------------------------------------------------------------------------------------------


DEPTH = "encoder.depth_predictor."  # prefix of the depth network's tensors

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
    return {path: published_tensor(tuple(path.split("/")), x.shape) for path, x in _by_path(_shapes(config)).items()}


def as_published(config: StreamConfig) -> StreamConfig:
    """`config` with the behavior of the code that the published weights were trained with.

    That code has one range of depths, and reads depth in the space of the candidates (`depth_readout="mean"`), where
    the paper prints metric depths.
    """
    return config.replace(upstream_compat=True, **PUBLISHED)


def import_params(path: Path, config: StreamConfig, *, depth_only: bool = False) -> ImportedParams:
    """Imports parameters from a `.safetensors` or `.npz` file that has PyTorch's names.

    Args:
        path: the file.
        config: configuration of a model with ReSplat's network.
        depth_only: import the depth network only, as from a checkpoint of DepthSplat, whose later stages differ.

    Raises:
        InputError: the file is of another kind, is damaged, has no tensors of this network, has only some tensors of a
            part, or has tensors of other shapes.
    """
    found = read_tensors(path)
    if not any(name.startswith("encoder.") for name in found):  # a depth network without the model around it
        found = {DEPTH + name: x for name, x in found.items()}
    by_place = published_tensors(config)
    shapes = {t.name: t.shape for t in by_place.values() if t is not None}
    usable = {name: shapes[name] for name in shapes if name in found and (name.startswith(DEPTH) or not depth_only)}
    initialized_parts = _initialized_parts(path, by_place, usable)
    if not usable:
        wanted = "weights of ReSplat, its depth network or Depth Anything V2"
        raise InputError(f"{path}: wanted {wanted}; the file has none of their {len(shapes)} tensors.")
    for name, shape in usable.items():
        if (got := found[name].shape) != shape:
            raise InputError(f"{path}: wanted {name} of shape {shape}, got {got}; is it another network's?")
        if not np.isfinite(found[name]).all():
            raise InputError(f"{path}: {name} holds values that are not finite; fetch the file again.")
    incomplete = {place.partition("/")[0] for place, t in by_place.items() if t is None or t.name not in usable}
    fresh = init_params(jax.random.key(0), config, incomplete)

    def parameter(keys, _):
        tensor = by_place["/".join(k.key for k in keys)]
        if tensor is not None and tensor.name in usable:
            return jnp.asarray(tensor.to_parameter(found[tensor.name]))
        return functools.reduce(lambda tree, k: tree[k.key], keys, fresh)

    params = jax.tree_util.tree_map_with_path(parameter, _shapes(config))
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
