"""Weights that ReSplat's PyTorch code saved, as parameters of `network="resplat"` (ALGORITHM 2.10, 3, 7).

Parameters are called as their modules are in PyTorch, so a name is found by a rule and not in a table:

    encoder/backbone/layer1_0/conv1/kernel      encoder.depth_predictor.backbone.layer1.0.conv1.weight
    mixer/blocks_0/attn/qkv/kernel              encoder.pt.blocks.0.attn.qkv.weight

Files of the depth network alone have the same names without `encoder.depth_predictor.`; of Depth Anything V2 only
`pretrained.` is read. What a file does not have stays as it was initialized: HPDA and CGFI, which are the paper's own,
always.
"""

import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ssplat_jax.config import StreamConfig
from ssplat_jax.errors import InputError
from ssplat_jax.model import init_params
from ssplat_jax.storage.torch_files import read_arrays, read_shapes

DEPTH = "encoder.depth_predictor."
PREFIXES = {
    "encoder": DEPTH,
    "cost_volume": DEPTH,
    "upsampler": f"{DEPTH}upsampler.",
    "tokens": "encoder.",
    "mixer": "encoder.pt.",
    "decoder": "encoder.",
}
PARTS = (
    *(f"{DEPTH}{part}." for part in ("backbone", "transformer", "pretrained", "upsampler")),
    (f"{DEPTH}regressor.", f"{DEPTH}regressor_residual.", f"{DEPTH}depth_head."),
    ("encoder.gaussian_regressor.", "encoder.proj."),
    "encoder.pt.",
    "encoder.gaussian_head.",
)
"""A file has all tensors of a part or none."""


class Tensor(NamedTuple):
    """Where a parameter comes from."""

    name: str
    shape: tuple[int, ...]
    to_parameter: Callable[[np.ndarray], np.ndarray]


class Imported(NamedTuple):
    """Parameters, and what of them is from the file."""

    params: dict
    num_imported: int
    num_unused: int
    fresh: tuple[str, ...]
    """Parts that the file does not have, by the first of their modules."""


def tensor_of(path: tuple[str, ...], shape: tuple[int, ...]) -> Tensor | None:
    """The PyTorch tensor that the parameter at `path` is; None where upstream has nothing like it."""
    if path[0] not in PREFIXES:
        return None
    *modules, leaf = path[1:]
    words = [re.sub(r"_(\d+)", r".\1", module) for module in modules]
    name = PREFIXES[path[0]] + ".".join([*words, {"kernel": "weight", "scale": "weight"}.get(leaf, leaf)])
    if leaf != "kernel":
        return Tensor(name, shape, lambda x: x)
    if len(shape) == 2:
        # Some linear layers are convolutions of one tap there: those of the U-Net's attention, and the CNN's skips.
        taps = (1,) if path[0] == "cost_volume" else (1, 1) if "downsample" in name else ()
        return Tensor(name, (*shape[::-1], *taps), lambda x: x.reshape(x.shape[:2]).T)
    height, width, channels, features = shape
    if "resize_layers.0" in name or "resize_layers.1" in name:  # transposed convolutions
        return Tensor(name, (channels, features, height, width), lambda x: x.transpose(2, 3, 0, 1))
    return Tensor(name, (features, channels, height, width), lambda x: x.transpose(2, 3, 1, 0))


def tensors_of(config: StreamConfig) -> dict[str, Tensor | None]:
    """Every parameter of a model with `config`, by path, and the tensor that it is."""
    wanted = jax.eval_shape(lambda key: init_params(key, config), jax.random.key(0))
    leaves = jax.tree_util.tree_flatten_with_path(wanted)[0]
    return {"/".join(k.key for k in keys): tensor_of(tuple(k.key for k in keys), x.shape) for keys, x in leaves}


def import_params(path: Path, config: StreamConfig, seed: int = 0, *, depth_only: bool = False) -> Imported:
    """Parameters of a model with `config` from a checkpoint of PyTorch (`.pth`, `.ckpt`, `.npz`).

    With `depth_only`, what stands behind the depth is left in the file: DepthSplat's is another than ReSplat's.

    Raises:
        InputError: a configuration of another network, a file that is no state dict, is damaged, has nothing of this
            network, only some tensors of a part, or tensors of other shapes.
    """
    if config.network.kind != "resplat":
        raise InputError(f"import-weights: wanted a preset of ReSplat's network (small, base), got {config.preset!r}.")
    held = read_shapes(path)
    # A depth network by itself is saved without the names of what it stood in.
    bare = "" if any(name.startswith("encoder.") for name in held) else DEPTH
    places = tensors_of(config)
    tensors = {place: t for place, t in places.items() if t is not None}
    in_file = {t.name: t.name.removeprefix(bare) for t in tensors.values()}
    wanted = {t.name for t in tensors.values() if t.name.startswith(DEPTH) or not depth_only}
    missing = {t.name for t in tensors.values() if t.name not in wanted or in_file[t.name] not in held}
    fresh = []
    for part in PARTS:
        of_part = [t.name for t in tensors.values() if t.name.startswith(part)]
        absent = [name for name in of_part if name in missing]
        if 0 < len(absent) < len(of_part):
            raise InputError(
                f"{path}: wanted an array {in_file[absent[0]]}, the file has none; is it another network's?"
            )
        if absent:
            first = part if isinstance(part, str) else part[0]
            fresh.append(first.removeprefix(DEPTH).removeprefix("encoder.").strip("."))
    if len(missing) == len(tensors):
        raise InputError(
            f"{path}: wanted weights of ReSplat, its depth network or Depth Anything V2; the file has none of their"
            f" {len(tensors)} tensors."
        )
    lacking = {place.partition("/")[0] for place, t in places.items() if t is None or t.name in missing}
    arrays = read_arrays(path, {in_file[t.name]: t.shape for t in tensors.values() if t.name not in missing})

    params = init_params(jax.random.key(seed), config, lacking)
    for place, tensor in tensors.items():
        if tensor.name not in missing:
            *folders, leaf = place.split("/")
            folder = params
            for name in folders:
                folder = folder.setdefault(name, {})
            folder[leaf] = jnp.asarray(tensor.to_parameter(arrays[in_file[tensor.name]]))
    return Imported(params, len(arrays), len(held) - len(arrays), tuple(fresh))
