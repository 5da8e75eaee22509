"""Weights files: parameters by path, float16 on disk (imported ones float32), float32 in use."""

import hashlib
from collections.abc import Mapping
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ssplat_jax.config import PRESETS, StreamConfig, preset
from ssplat_jax.errors import InputError, StorageError
from ssplat_jax.model import init_params
from ssplat_jax.storage.npz import load_arrays, save_arrays

KIND = "weights"


def save_weights(
    path: Path, params: dict, config: StreamConfig, provenance: dict, dtype: type[np.floating] = np.float16
) -> None:
    """Writes the parameters of a model with `config`; `provenance` says how they came to be (steps, data, scores).

    Raises:
        StorageError: a value is not finite, or too large for `dtype`.
    """
    leaves = {"/".join(k.key for k in keys): leaf for keys, leaf in jax.tree_util.tree_flatten_with_path(params)[0]}
    with np.errstate(over="ignore"):  # becomes infinite, and is refused below
        arrays = {name: np.asarray(leaf, dtype) for name, leaf in leaves.items()}
    if bad := [name for name, x in arrays.items() if not np.isfinite(x).all()]:
        raise StorageError(f"{path}: {bad[0]} has values beyond {np.dtype(dtype)} or not finite; not saved.")
    save_arrays(path, arrays, KIND, {"config": config.to_dict(), "provenance": provenance})


def load_weights(path: Path) -> tuple[dict, StreamConfig]:
    """(params, config) of a weights file.

    Raises:
        StorageError: missing, corrupt or of another kind.
        InputError: weights whose shapes its configuration does not give.
    """
    arrays, header = load_arrays(path, KIND)
    config = StreamConfig.from_dict(header["config"])
    return _restore(path, arrays, config), config


def load_params(name: str = "tiny") -> dict:
    """Trained parameters: the shipped ones of a preset, or those of a weights file.

    Raises:
        InputError: no preset and no file of that name, or weights of other shapes.
        StorageError: the file is corrupt.
    """
    if name not in PRESETS:
        if not Path(name).is_file():
            known = ", ".join(preset for preset in sorted(PRESETS) if _shipped(preset).is_file())
            raise InputError(f"weights: wanted a preset with shipped weights ({known}) or a file, got {name!r}.")
        return load_weights(Path(name))[0]
    shipped = _shipped(name)
    if not shipped.is_file():
        raise InputError(
            f"weights: none ship with the preset {name!r}; convert ReSplat's (ssplat import-weights) or train"
            f" (ssplat train --preset {name}), and give the file."
        )
    with resources.as_file(shipped) as path:
        arrays, _ = load_arrays(path, KIND)
        return _restore(path, arrays, preset(name))


def _shipped(preset_name: str) -> Traversable:
    """Where the package holds the weights of a preset, if it has them."""
    return resources.files("ssplat_jax") / "weights" / f"{preset_name}.npz"


def params_digest(params: dict) -> str:
    """Twelve hex digits that name these parameters in saved states."""
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(params):  # dicts are traversed in the order of their keys
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()[:12]


def check_params(params: dict, config: StreamConfig, origin: str) -> None:
    """Whether `params` are those of a model with `config`.

    Raises:
        InputError: `config` wants parameters that are not there or of other shapes (more than it wants, as for
            `mixer_blocks=0`, is no fault); `origin` says where the parameters came from.
    """
    named = {"/".join(k.key for k in keys): leaf for keys, leaf in jax.tree_util.tree_flatten_with_path(params)[0]}
    _restore(origin, named, config)


def _restore(path: Path | str, arrays: Mapping[str, Any], config: StreamConfig) -> dict:
    """Arrays by path as the tree that `config` wants, every shape checked."""
    wanted = jax.eval_shape(lambda key: init_params(key, config), jax.random.key(0))

    def leaf(keys, shape):
        name = "/".join(k.key for k in keys)
        if name not in arrays or arrays[name].shape != shape.shape:
            came = arrays[name].shape if name in arrays else "nothing"
            raise InputError(f"{path}: {name} must be {shape.shape}, got {came}; the weights are of another config.")
        return jnp.asarray(arrays[name], jnp.float32)

    return jax.tree_util.tree_map_with_path(leaf, wanted)
