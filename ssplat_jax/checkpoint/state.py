"""The stream's state on disk: one `.npz`, no pickle, that is either read back exactly or refused.

    header          JSON bytes: format, version, capacity, dtype and sha256 of every leaf, and the caller's own facts
    <leaf>          arrays by their path in `VoxelCache` (`means`, `stats.num_seen`); of those with one row per voxel
                    only the occupied rows, since the others hold zeros
    archive comment sha256 of every byte before it, so that no bit of the file can change unnoticed

`numpy.load` reads the file as it is. A file is written beside its final name, synced and renamed: at every moment
either the old or the new state is there, whole. The old one stays as `<name>.previous`.
"""

import hashlib
import io
import json
import os
import zipfile
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ssplat_jax.cache.state import PIVOT_FIELDS, CacheStats, VoxelCache
from ssplat_jax.errors import StorageError

FORMAT = "ssplat-state"
VERSION = 1

_ROW_FIELDS = ("voxels", "counts", *PIVOT_FIELDS)
_DIGEST_LENGTH = 64  # hex digits


def save_state(path: Path, cache: VoxelCache, header: dict[str, Any]) -> None:
    """Writes `cache` and the JSON-able `header` to `path`, atomically; what was there becomes `<name>.previous`.

    Raises:
        StorageError: the file could not be written; what was at `path` before is untouched.
    """
    path = Path(path)
    leaves = _leaves(cache)
    described = {name: {"dtype": str(x.dtype), "sha256": _digest(x)} for name, x in leaves.items()}
    facts = {"format": FORMAT, "version": VERSION, "capacity": cache.capacity, "leaves": described, "header": header}
    text = np.frombuffer(json.dumps(facts, sort_keys=True).encode(), np.uint8)
    partial = path.with_name(path.name + ".partial")
    try:
        with open(partial, "w+b") as file:
            arrays = {"header": text} | {name: _as_bits(x) for name, x in leaves.items()}
            np.savez(file, **arrays)  # pyright: ignore[reportArgumentType]
            _seal(file)
            os.fsync(file.fileno())
        if path.exists():
            os.replace(path, previous_path(path))
        os.replace(partial, path)
        _sync_directory(path.parent)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise StorageError(
            f"{path}: could not save the stream's state ({error}); free some space or choose another --out."
        ) from error


def load_state(path: Path) -> tuple[VoxelCache, dict[str, Any]]:
    """The cache and the header that `save_state` wrote.

    Raises:
        StorageError: no such file, or one that is not, bit for bit, what was written.
    """
    path = Path(path)
    try:
        contents = path.read_bytes()
    except OSError as error:
        raise StorageError(f"{path}: could not read the stream's state ({error}).") from error
    try:
        return _parse(contents)
    except (ValueError, KeyError, TypeError, OSError, EOFError, zipfile.BadZipFile) as error:
        raise StorageError(
            f"{path}: the state file is corrupt ({error}); resume from {previous_path(path).name} or start anew."
        ) from error


def load_newest_state(path: Path) -> tuple[VoxelCache, dict[str, Any], StorageError | None]:
    """As `load_state`, but falls back on the previous file; also why the newest was refused, if it was.

    Raises:
        StorageError: neither file is good; the message is about the newest.
    """
    try:
        return *load_state(path), None
    except StorageError as error:
        if not previous_path(path).exists():
            raise
        return *load_state(previous_path(path)), error


def previous_path(path: Path) -> Path:
    """Where the state before the one at `path` is kept."""
    return Path(path).with_name(Path(path).name + ".previous")


def _leaves(cache: VoxelCache) -> dict[str, np.ndarray]:
    num_voxels = int(cache.num_voxels)
    leaves = {}
    for path, leaf in jax.tree_util.tree_flatten_with_path(cache)[0]:
        name = ".".join(key.name for key in path)
        array = leaf[:num_voxels] if name in _ROW_FIELDS else leaf
        leaves[name] = np.ascontiguousarray(np.asarray(array)).reshape(array.shape)
    return leaves


def _parse(contents: bytes) -> tuple[VoxelCache, dict[str, Any]]:
    seal = contents[-_DIGEST_LENGTH:]
    if hashlib.sha256(memoryview(contents)[:-_DIGEST_LENGTH]).hexdigest().encode() != seal:
        raise ValueError("its checksum does not match")
    with np.load(io.BytesIO(contents), allow_pickle=False) as arrays:
        facts = json.loads(arrays["header"].tobytes())
        if (facts["format"], facts["version"]) != (FORMAT, VERSION):
            raise ValueError(f"format {facts['format']} {facts['version']}, wanted {FORMAT} {VERSION}")
        leaves = {}
        for name, description in facts["leaves"].items():
            leaf = arrays[name].view(jnp.dtype(description["dtype"]))
            if _digest(leaf) != description["sha256"]:
                raise ValueError(f"the checksum of {name} does not match")
            leaves[name] = leaf
    return _build(leaves, facts["capacity"]), facts["header"]


def _build(leaves: dict[str, np.ndarray], capacity: int) -> VoxelCache:
    stats = {name.removeprefix("stats."): jnp.asarray(x) for name, x in leaves.items() if name.startswith("stats.")}
    fields: dict[str, Any] = {}
    for name, leaf in leaves.items():
        if name in _ROW_FIELDS:
            full = np.zeros((capacity, *leaf.shape[1:]), leaf.dtype)
            full[: len(leaf)] = leaf
            fields[name] = jnp.asarray(full)
        elif not name.startswith("stats."):
            fields[name] = jnp.asarray(leaf)
    return VoxelCache(**fields, stats=CacheStats(**stats))


def _as_bits(x: np.ndarray) -> np.ndarray:
    """The array as `.npy` can name it: bfloat16 as its 16 bits."""
    return x if x.dtype.isbuiltin == 1 else x.view(f"u{x.dtype.itemsize}")


def _digest(x: np.ndarray) -> str:
    return hashlib.sha256(f"{x.dtype} {x.shape} ".encode() + x.tobytes()).hexdigest()


def _seal(file) -> None:
    """Gives the archive in `file` a comment: the sha256 of every byte before the comment."""
    file.seek(-2, os.SEEK_END)  # the last field of a zip file without comment is the comment's length
    file.write(_DIGEST_LENGTH.to_bytes(2, "little"))
    file.seek(0)
    digest = hashlib.file_digest(file, "sha256").hexdigest()
    file.seek(0, os.SEEK_END)
    file.write(digest.encode())
    file.flush()


def _sync_directory(directory: Path) -> None:
    """Makes the renames themselves durable."""
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
