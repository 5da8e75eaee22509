"""Weights files: parameters by path (`encoder/conv1/kernel`), stored as float16 or float32 and loaded as float32."""

import dataclasses
import functools
import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.flatten_util import ravel_pytree

from ssplat_jax.config import PRESETS, StreamConfig, preset
from ssplat_jax.core.errors import InputError, StorageError
from ssplat_jax.model.network import init_params
from ssplat_jax.storage.files import load_arrays, save_arrays

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
    return _restore(path, arrays, preset(name) if name in PRESETS else facts.config)


def _path_of(name: str) -> Path:
    """The file of the weights `name`; see `load_params`."""
    file = SHIPPED / f"{name}.npz" if name in PRESETS else Path(name)
    if file.is_file():
        return file
    if name in PRESETS:
        raise InputError(
            f"weights: none ship with the preset {name!r}; convert ReSplat's (ssplat import-weights) or train"
            f" (ssplat train --preset {name}), and give the file."
        )
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
            # What is left of `after` without its part along the start: 1 - cos^2 would cancel for small angles.
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


def _restore(path: Path | str, arrays: Mapping[str, Any], config: StreamConfig) -> dict:
    """Builds the parameter tree of a model with `config` from arrays by path, and checks their shapes."""

    def leaf(keys, shape):
        name = "/".join(k.key for k in keys)
        if name not in arrays or arrays[name].shape != shape.shape:
            came = arrays[name].shape if name in arrays else "nothing"
            raise InputError(
                f"{path}: {name} must be {shape.shape}, got {came}; the weights belong to another configuration."
            )
        return jax.device_put(np.asarray(arrays[name], np.float32))  # jnp.asarray compiles a program for each shape

    return jax.tree_util.tree_map_with_path(leaf, _shapes(config))


@functools.lru_cache(maxsize=8)  # tracing a network takes a second
def _shapes(config: StreamConfig) -> dict:
    return jax.eval_shape(lambda: init_params(jax.random.key(0), config))
