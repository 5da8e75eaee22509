"""Saved states of streams and trainings: the newest and the one before it, so that damage costs one interval.

A stream state holds the leaves of the cache by path (`means`, `stats.num_seen`). Arrays with one row per voxel are
stored without their unoccupied rows, which hold zeros.
"""

import contextlib
import functools
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
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
from ssplat_jax.core.atomic import previous_path
from ssplat_jax.core.errors import InputError, StorageError
from ssplat_jax.storage.files import load_arrays, save_arrays

KIND, TRAINING_KIND = "stream state 1", "training state 1"

T = TypeVar("T")

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
        (groups.setdefault(owner[0], {}) if owner else fields)[field] = jnp.asarray(leaf)
    cache = VoxelCache(**fields, **{name: _GROUPS[name](**leaves) for name, leaves in groups.items()})
    return cache, facts["caller"]


def load_newest_state(path: Path) -> tuple[VoxelCache, dict[str, Any], StorageError | None]:
    """Reads the newest state, or the previous one if the newest is missing or damaged.

    Returns:
        The cache, the header, and the error of the newest file if the previous one was read, else None.

    Raises:
        StorageError: neither file can be read; the message is about the newest.
    """
    (cache, header), damage = _newest(path, load_state)
    return cache, header, damage


def _newest(path: Path, load: Callable[[Path], T]) -> tuple[T, StorageError | None]:
    """What `load` reads from the newest file, or from the previous one with the error of the newest."""
    try:
        return load(path), None
    except StorageError as error:
        with contextlib.suppress(StorageError):
            return load(previous_path(path)), error
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
    """The state of a training in `<directory>/state.npz`, and the one before it.

    Args:
        directory: created if missing.
        description: JSON-serializable facts that determine the training, such as the recipe and the configuration.
    """

    def __init__(self, directory: Path, description: dict) -> None:
        self.path, self._description = Path(directory) / "state.npz", json.loads(json.dumps(description))

    def save(self, step: int, state: Any) -> None:
        """Saves a pytree of arrays as the state after `step`; the state before it is kept too.

        Raises:
            StorageError: the file cannot be written.
        """
        leaves = {f"{i:04d}": np.asarray(leaf) for i, leaf in enumerate(jax.tree.leaves(state))}
        header = {"step": step, "training": self._description}
        save_arrays(self.path, leaves, TRAINING_KIND, header, keep_previous=True)

    def restore_latest(self, like: Any, warn: Callable[[str], None]) -> tuple[int, Any] | None:
        """(step, state) of the newest intact state, or None if there is none.

        Args:
            like: a state of the same structure, shapes and types.
            warn: called with a message if the newest is damaged; it is kept as `state.npz.damaged`.

        Raises:
            InputError: the directory holds another training.
            StorageError: no state can be read, or it is of another version of the package.
        """
        if not (self.path.exists() or previous_path(self.path).exists()):
            return None
        (arrays, header), damage = _newest(self.path, functools.partial(load_arrays, kind=TRAINING_KIND))
        if (difference := first_difference(header["training"], self._description)) is not None:
            name, held, wanted = difference
            raise InputError(
                f"{self.path}: this directory holds a run with {name} = {held!r}, wanted {wanted!r}; choose another"
                " --out, or repeat the old options with the old files."
            )
        leaves, structure = jax.tree.flatten(like)
        held = [arrays[name] for name in sorted(arrays)]
        if [(x.shape, x.dtype) for x in held] != [(x.shape, x.dtype) for x in leaves]:
            raise StorageError(f"{self.path}: the state is of another version; choose another --out.")
        if damage is not None:
            warn(f"{damage} Continuing from the state saved before it, after step {header['step']}.")
            restore_previous(self.path)
        return header["step"], jax.tree.unflatten(structure, map(jnp.asarray, held))


def first_difference(held: Any, wanted: Any, name: str = "") -> tuple[str, Any, Any] | None:
    """(path, held, wanted) of the first difference between two JSON values, or None."""
    if isinstance(held, dict) and isinstance(wanted, dict):
        pairs = [(f"{name}.{k}".lstrip("."), held.get(k), wanted.get(k)) for k in sorted(held.keys() | wanted.keys())]
    elif isinstance(held, list) and isinstance(wanted, list) and len(held) == len(wanted):
        pairs = [(f"{name}[{i}]", a, b) for i, (a, b) in enumerate(zip(held, wanted, strict=True))]
    else:
        return None if held == wanted else (name, held, wanted)
    return next((found for path, a, b in pairs if (found := first_difference(a, b, path)) is not None), None)
