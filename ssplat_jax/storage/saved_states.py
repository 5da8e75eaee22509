"""Saved states of streams and trainings: the newest and the one before it, so that damage costs one interval.

A stream state holds the leaves of the cache by path (`means`, `stats.num_seen`). Arrays with one row per voxel are
stored without their unoccupied rows, which hold zeros.
"""

import contextlib
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ssplat_jax.cache.key_views import KeyViews
from ssplat_jax.cache.state import (
    OPTIONAL_PIVOT_FIELDS,
    PIVOT_FIELDS,
    CacheStats,
    StoredDepths,
    VoxelCache,
    require_single_cache,
)
from ssplat_jax.core.atomic import previous_path, write_atomic
from ssplat_jax.core.errors import InputError, StorageError
from ssplat_jax.storage.files import load_arrays, save_arrays

KIND, TRAINING_KIND = "stream state 1", "training state 1"

_ROW_FIELDS = ("voxels", "counts", *PIVOT_FIELDS, *OPTIONAL_PIVOT_FIELDS)  # arrays with one row per voxel
_GROUPS = {"stats": CacheStats, "stored_depths": StoredDepths, "key_views": KeyViews}  # parts with fields of their own


def save_state(path: Path, cache: VoxelCache, header: dict[str, Any]) -> None:
    """Writes `cache` and a JSON-serializable `header` to `path`, atomically; the old file becomes `<name>.previous`.

    Raises:
        StorageError: the file cannot be written; the old file at `path` is unchanged.
        InputError: `cache` is a batch of caches, of several streams or shards.
    """
    require_single_cache(cache, "save_state")
    num_voxels = int(cache.num_voxels)
    leaves = {}
    for keys, leaf in jax.tree_util.tree_flatten_with_path(cache)[0]:
        name = ".".join(key.name for key in keys)
        # Sliced on the host: JAX would compile a program for each number of voxels, which differs at every save.
        array = np.asarray(leaf)[:num_voxels] if name in _ROW_FIELDS else np.asarray(leaf)
        leaves[name] = np.ascontiguousarray(array).reshape(array.shape)
    save_arrays(path, leaves, KIND, {"capacity": cache.capacity, "caller": header}, keep_previous=True)


def load_state(path: Path) -> tuple[VoxelCache, dict[str, Any]]:
    """Reads the cache and the header that `save_state` wrote."""
    leaves, facts = load_arrays(path, KIND)
    fields: dict[str, Any] = {}
    groups: dict[str, dict[str, Any]] = {}
    for name, leaf in leaves.items():
        if name in _ROW_FIELDS:  # as long as the capacity again
            leaf = np.pad(leaf, [(0, facts["capacity"] - len(leaf)), *[(0, 0)] * (leaf.ndim - 1)])
        *owner, field = name.split(".")
        (groups.setdefault(owner[0], {}) if owner else fields)[field] = jax.device_put(leaf)  # jnp.asarray compiles
    cache = VoxelCache(**fields, **{name: _GROUPS[name](**leaves) for name, leaves in groups.items()})
    return cache, facts["caller"]


def load_newest_state(path: Path) -> tuple[VoxelCache, dict[str, Any], StorageError | None]:
    """Reads the newest state, or the previous one if the newest is missing or damaged.

    Returns:
        The cache, the header, and the error of the newest file if the previous one was read, else None.

    Raises:
        StorageError: neither file can be read; the message is about the newest.
    """
    return _load_newest(path, load_state)


def _load_newest(path: Path, load: Callable[[Path], tuple[Any, Any]]) -> tuple[Any, Any, StorageError | None]:
    try:
        return *load(path), None
    except StorageError as error:
        with contextlib.suppress(StorageError):
            return *load(previous_path(path)), error
        raise


def restore_previous(path: Path) -> None:
    """Replaces a damaged or missing state by the previous one; the damaged file is kept as `<name>.damaged`.

    Call this before going on from the previous state: the next save would otherwise keep the damaged file as the
    previous state and overwrite the only good one.

    Raises:
        StorageError: a file cannot be renamed.
    """
    try:
        if path.exists():
            # Another machine or a later version may be able to read the damaged file.
            os.replace(path, path.with_name(path.name + ".damaged"))
        os.replace(previous_path(path), path)
    except OSError as error:
        raise StorageError(f"{path}: cannot be replaced by {previous_path(path).name} ({error.strerror}).") from error


class TrainingCheckpoints:
    """Training states in a directory, beside the description of the run: the newest and the one before it.

    Args:
        directory: created if missing.
        description: JSON-serializable facts that determine the run, such as the recipe and the model configuration. A
            directory with another description is refused.

    Raises:
        InputError: the directory holds another run.
        StorageError: its recipe.json is damaged.
    """

    def __init__(self, directory: Path, description: dict) -> None:
        recipe, self._path = directory / "recipe.json", directory / "checkpoint.npz"
        text = json.dumps(description, indent=1, sort_keys=True)
        if not recipe.exists():
            write_atomic(recipe, text.encode())
        try:
            difference = first_difference(json.loads(recipe.read_text()), json.loads(text))
        except ValueError as error:
            raise StorageError(f"{recipe}: damaged; restore it or choose another --out.") from error
        if difference is not None:
            name, held, wanted = difference
            raise InputError(
                f"{recipe}: this directory holds a run with {name} = {held!r}, wanted {wanted!r}; choose another --out,"
                " or repeat the old options with the old files."
            )

    def save(self, step: int, state: Any) -> None:
        """Saves a pytree of arrays as the state after `step`; the state before it is kept too.

        Raises:
            StorageError: the state cannot be written.
        """
        leaves = {f"{i:04d}": np.asarray(leaf) for i, leaf in enumerate(jax.tree.leaves(state))}
        save_arrays(self._path, leaves, TRAINING_KIND, {"step": step}, keep_previous=True)

    def restore_latest(self, like: Any, warn: Callable[[str], None]) -> tuple[int, Any] | None:
        """(step, state) of the newest intact checkpoint, or None if there is none.

        Args:
            like: a state of the same structure, shapes and types.
            warn: called with a message if the newest is damaged; it is kept as `checkpoint.npz.damaged`.

        Raises:
            StorageError: both checkpoints are damaged, or they have other shapes; they are left in place.
        """
        if not (self._path.exists() or previous_path(self._path).exists()):
            return None
        wanted, structure = jax.tree.flatten(like)

        def load(path: Path) -> tuple[int, Any]:
            arrays, header = load_arrays(path, TRAINING_KIND)
            leaves = [arrays[name] for name in sorted(arrays)]
            if [(x.shape, x.dtype) for x in leaves] != [(x.shape, x.dtype) for x in wanted]:
                raise StorageError(f"{path}: holds a training of other shapes; choose another --out.")
            return header["step"], jax.tree.unflatten(structure, jax.device_put(leaves))

        step, state, damage = _load_newest(self._path, load)
        if damage is not None:
            warn(f"{damage} Continuing from step {step}.")
            restore_previous(self._path)
        return step, state


def first_difference(held: Any, wanted: Any, name: str = "") -> tuple[str, Any, Any] | None:
    """(path, held, wanted) of the first difference between two JSON values, or None."""
    if isinstance(held, dict) and isinstance(wanted, dict):
        pairs = [(f"{name}.{k}".lstrip("."), held.get(k), wanted.get(k)) for k in sorted(held.keys() | wanted.keys())]
    elif isinstance(held, list) and isinstance(wanted, list) and len(held) == len(wanted):
        pairs = [(f"{name}[{i}]", a, b) for i, (a, b) in enumerate(zip(held, wanted, strict=True))]
    else:
        return None if held == wanted else (name, held, wanted)
    return next((found for path, a, b in pairs if (found := first_difference(a, b, path)) is not None), None)
