"""The stream's state on disk: the cache's leaves by their path (`means`, `stats.num_seen`), the last file kept.

Of the arrays with one row per voxel only the occupied rows are stored, since the others hold zeros.
"""

import contextlib
import os
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ssplat_jax.cache.state import PIVOT_FIELDS, CacheStats, VoxelCache, Witnesses, require_one
from ssplat_jax.errors import StorageError
from ssplat_jax.storage.atomic import previous_path
from ssplat_jax.storage.npz import load_arrays, save_arrays

KIND = "stream state 3"  # 2: with witnesses; 3: colors of the parts of a patch, at one exposure
_ROW_FIELDS = ("voxels", "counts", *PIVOT_FIELDS)


def save_state(path: Path, cache: VoxelCache, header: dict[str, Any]) -> None:
    """Writes `cache` and the JSON-able `header` to `path`, atomically; what was there becomes `<name>.previous`.

    Raises:
        StorageError: the file could not be written; what was at `path` before is untouched.
        InputError: `cache` is several, of streams or shards.
    """
    require_one(cache, "save_state")
    facts = {"capacity": cache.capacity, "caller": header}
    save_arrays(path, _leaves(cache), KIND, facts, keep_previous=True)


def load_state(path: Path) -> tuple[VoxelCache, dict[str, Any]]:
    """The cache and the header that `save_state` wrote.

    Raises:
        StorageError: no such file, or one that is not, bit for bit, what was written.
    """
    leaves, facts = load_arrays(path, KIND)
    return _build(leaves, facts["capacity"]), facts["caller"]


def load_newest_state(path: Path) -> tuple[VoxelCache, dict[str, Any], StorageError | None]:
    """As `load_state`, but falls back on the previous file; also why the newest was refused, if it was.

    Raises:
        StorageError: neither file is good; the message is about the newest.
    """
    try:
        return *load_state(path), None
    except StorageError as error:
        with contextlib.suppress(StorageError):
            return *load_state(previous_path(path)), error
        raise


def restore_previous(path: Path) -> None:
    """Puts the previous state in the place of a damaged or missing one, which is kept as `<name>.damaged`.

    Whoever continues from the previous state does so first: the next save keeps what is at `path` as the previous
    state, and would put a damaged file over the only good one.

    Raises:
        StorageError: the file could not be renamed.
    """
    try:
        if path.exists():
            # What could not be read now may be readable elsewhere, or with a later version.
            os.replace(path, path.with_name(path.name + ".damaged"))
        os.replace(previous_path(path), path)
    except OSError as error:
        raise StorageError(f"{path}: cannot be replaced by {previous_path(path).name} ({error.strerror}).") from error


def _leaves(cache: VoxelCache) -> dict[str, np.ndarray]:
    num_voxels = int(cache.num_voxels)
    leaves = {}
    for path, leaf in jax.tree_util.tree_flatten_with_path(cache)[0]:
        name = ".".join(key.name for key in path)
        # Cut on the host: JAX would compile a program for every number of voxels, and there is a new one at every save.
        array = np.asarray(leaf)[:num_voxels] if name in _ROW_FIELDS else np.asarray(leaf)
        leaves[name] = np.ascontiguousarray(array).reshape(array.shape)
    return leaves


def _build(leaves: dict[str, np.ndarray], capacity: int) -> VoxelCache:
    fields: dict[str, Any] = {"stats": {}, "witnesses": {}}
    for name, leaf in leaves.items():
        if name in _ROW_FIELDS:
            full = np.zeros((capacity, *leaf.shape[1:]), leaf.dtype)
            full[: len(leaf)] = leaf
            leaf = full
        *owner, field = name.split(".")
        (fields[owner[0]] if owner else fields)[field] = jnp.asarray(leaf)
    return VoxelCache(
        **fields | {"stats": CacheStats(**fields["stats"]), "witnesses": Witnesses(**fields["witnesses"])}
    )
