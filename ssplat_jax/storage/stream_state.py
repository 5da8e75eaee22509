"""Stream state on disk: the leaves of the cache by path (`means`, `stats.num_seen`); the previous file is kept.

Arrays with one row per voxel are stored without their unoccupied rows, which hold zeros.
"""

import contextlib
import os
from pathlib import Path
from typing import Any

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
from ssplat_jax.core.errors import StorageError
from ssplat_jax.storage.npz import load_arrays, save_arrays

KIND = "stream state 3"  # version 2 added witnesses; version 3 colors per part of a patch, at one exposure
_ROW_FIELDS = ("voxels", "counts", *PIVOT_FIELDS, *OPTIONAL_PIVOT_FIELDS)  # arrays with one row per voxel

_GROUPS = {"stats": CacheStats, "stored_depths": StoredDepths, "key_views": KeyViews}  # parts with fields of their own


def save_state(path: Path, cache: VoxelCache, header: dict[str, Any]) -> None:
    """Writes `cache` and a JSON-serializable `header` to `path`, atomically; the old file becomes `<name>.previous`.

    Raises:
        StorageError: the file cannot be written; the old file at `path` is unchanged.
        InputError: `cache` is a batch of caches, of several streams or shards.
    """
    require_single_cache(cache, "save_state")
    facts = {"capacity": cache.capacity, "caller": header}
    save_arrays(path, _leaves(cache), KIND, facts, keep_previous=True)


def load_state(path: Path) -> tuple[VoxelCache, dict[str, Any]]:
    """Reads the cache and the header that `save_state` wrote.

    Raises:
        StorageError: the file is missing, of another kind, or damaged.
    """
    leaves, facts = load_arrays(path, KIND)
    return _build(leaves, facts["capacity"]), facts["caller"]


def load_newest_state(path: Path) -> tuple[VoxelCache, dict[str, Any], StorageError | None]:
    """Reads the newest state, or the previous one if the newest is missing or damaged.

    Returns:
        The cache, the header, and the error of the newest file if the previous one was read, else None.

    Raises:
        StorageError: neither file can be read; the message is about the newest.
    """
    try:
        return *load_state(path), None
    except StorageError as error:
        with contextlib.suppress(StorageError):
            return *load_state(previous_path(path)), error
        raise


def restore_previous(path: Path) -> None:
    """Replaces a damaged or missing state by the previous one; the damaged file is kept as `<name>.damaged`.

    Call this before a stream continues from the previous state: the next save would otherwise keep the damaged file as
    the previous state and overwrite the only good one.

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


def _leaves(cache: VoxelCache) -> dict[str, np.ndarray]:
    """Leaves of the cache by path, row arrays cut to the occupied rows."""
    num_voxels = int(cache.num_voxels)
    leaves = {}
    for path, leaf in jax.tree_util.tree_flatten_with_path(cache)[0]:
        name = ".".join(key.name for key in path)
        # Sliced on the host: JAX would compile a program for each number of voxels, which differs at every save.
        array = np.asarray(leaf)[:num_voxels] if name in _ROW_FIELDS else np.asarray(leaf)
        leaves[name] = np.ascontiguousarray(array).reshape(array.shape)
    return leaves


def _build(leaves: dict[str, np.ndarray], capacity: int) -> VoxelCache:
    """Cache of the leaves by path, row arrays padded with zeros to `capacity`."""
    fields: dict[str, Any] = {}
    groups: dict[str, dict[str, Any]] = {}
    for name, leaf in leaves.items():
        if name in _ROW_FIELDS:
            full = np.zeros((capacity, *leaf.shape[1:]), leaf.dtype)
            full[: len(leaf)] = leaf
            leaf = full
        *owner, field = name.split(".")
        (groups.setdefault(owner[0], {}) if owner else fields)[field] = jnp.asarray(leaf)
    return VoxelCache(**fields, **{name: _GROUPS[name](**leaves) for name, leaves in groups.items()})
