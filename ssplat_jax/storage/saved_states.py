"""Saved states of streams and trainings: the newest and the one before it, so that damage costs one interval.

A stream state holds the leaves of the cache by path (`means`, `stats.num_seen`). Arrays with one row per voxel are
stored without their unoccupied rows, which hold zeros.
"""

import contextlib
import hashlib
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ssplat_jax.cache.key_views import KeyViews
from ssplat_jax.cache.state import ROW_FIELDS, CacheStats, StoredDepths, VoxelCache, require_single_cache
from ssplat_jax.core.atomic import previous_path, write_atomic
from ssplat_jax.core.errors import InputError, StorageError, echo
from ssplat_jax.storage.files import load_arrays, save_arrays

KIND = "stream state 1"

ANEW = "choose another --out, repeat the old options, or start anew with --overwrite"

_DIGEST = "sha256"  # name of the digest among the leaves of a checkpoint, which are numbered
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
        array = np.asarray(leaf)[:num_voxels] if name in ROW_FIELDS else np.asarray(leaf)
        leaves[name] = np.ascontiguousarray(array).reshape(array.shape)
    save_arrays(path, leaves, KIND, {"capacity": cache.capacity, "caller": header}, keep_previous=True)


def load_state(path: Path) -> tuple[VoxelCache, dict[str, Any]]:
    """Reads the cache and the header that `save_state` wrote."""
    leaves, facts = load_arrays(path, KIND)
    fields: dict[str, Any] = {}
    groups: dict[str, dict[str, Any]] = {}
    for name, leaf in leaves.items():
        if name in ROW_FIELDS:  # as long as the capacity again
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
    try:
        return *load_state(path), None
    except StorageError as error:
        with contextlib.suppress(StorageError):
            return *load_state(previous_path(path)), error
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
    """Training states in a directory, saved with Orbax, beside the description of the run; the last two are kept.

    Args:
        directory: created if missing.
        description: JSON-serializable facts that determine the run, such as the recipe and the model configuration. A
            directory with another description is refused.

    Raises:
        InputError: the directory holds another run.
        StorageError: its recipe.json is damaged.
    """

    def __init__(self, directory: Path, description: dict) -> None:
        self.directory, recipe = Path(directory).resolve(), Path(directory) / "recipe.json"
        text = json.dumps(description, indent=1, sort_keys=True)
        if not recipe.exists():
            write_atomic(recipe, text.encode())
        try:
            held = json.loads(recipe.read_text())
        except ValueError as error:
            raise StorageError(f"{recipe}: damaged; restore it or choose another --out.") from error
        fix = "choose another --out, or repeat the old options with the old files"
        check_same(recipe, "a run", held, json.loads(text), fix)

    def save(self, step: int, state: Any) -> None:
        """Saves a pytree of arrays as the state after `step`; the state before it is kept too."""
        import orbax.checkpoint as ocp

        leaves = {f"{i:04d}": np.asarray(leaf) for i, leaf in enumerate(jax.tree.leaves(state))}
        with self._manager() as manager:
            try:
                manager.save(step, args=ocp.args.StandardSave(leaves | {_DIGEST: _digest(leaves)}))
                manager.wait_until_finished()
            except (OSError, ValueError) as error:
                raise StorageError(f"{self.directory}: could not save step {step}: {error}") from error

    def restore_latest(self, like: Any, warn: Callable[[str], None]) -> tuple[int, Any] | None:
        """(step, state) of the newest intact checkpoint, or None if there is none.

        Args:
            like: a state of the same structure, shapes and types.
            warn: called with a message for each damaged checkpoint, which is moved to `damaged-<step>`.

        Raises:
            StorageError: all checkpoints are damaged or of other shapes; they are left in place.
        """
        with self._manager() as manager:
            steps = sorted(manager.all_steps(), reverse=True)
            for number, step in enumerate(steps):
                if (state := _restore(manager, step, like)) is None:
                    continue
                for damaged in steps[:number]:
                    warn(f"{self.directory}: checkpoint {damaged} is damaged; continuing from step {step}.")
                    aside = self.directory / f"damaged-{damaged}"
                    shutil.rmtree(aside, ignore_errors=True)
                    os.replace(self.directory / "checkpoints" / str(damaged), aside)
                return step, state
        if steps:
            numbers, fix = ", ".join(map(str, steps)), "choose another --out"
            raise StorageError(f"{self.directory}: checkpoints {numbers} are damaged or of another version; {fix}.")
        return None

    def _manager(self):
        import orbax.checkpoint as ocp  # takes seconds, which no stream needs

        options = ocp.CheckpointManagerOptions(max_to_keep=2, create=True, enable_async_checkpointing=False)
        return ocp.CheckpointManager(self.directory / "checkpoints", options=options)


def _restore(manager: Any, step: int, like: Any) -> Any | None:
    """The state of a checkpoint; None if it is damaged."""
    import orbax.checkpoint as ocp

    wanted, treedef = jax.tree.flatten(like)
    abstract = {f"{i:04d}": jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for i, leaf in enumerate(wanted)}
    abstract[_DIGEST] = jax.ShapeDtypeStruct((32,), np.uint8)
    try:
        held = manager.restore(step, args=ocp.args.StandardRestore(abstract))
    except Exception:  # a damaged checkpoint can make Orbax raise anything
        return None
    leaves = {name: np.asarray(leaf) for name, leaf in held.items() if name != _DIGEST}
    ordered = [leaves[name] for name in sorted(leaves)]
    is_like = [(x.shape, x.dtype) for x in ordered] == [(x.shape, x.dtype) for x in wanted]  # Orbax does not insist
    if not is_like or not np.array_equal(held[_DIGEST], _digest(leaves)):
        return None
    return jax.tree.unflatten(treedef, map(jnp.asarray, ordered))


def _digest(leaves: dict[str, np.ndarray]) -> np.ndarray:
    """sha256 of types, shapes and values: Orbax reads an array with a flipped bit without complaint."""
    digest = hashlib.sha256()
    for name, leaf in sorted(leaves.items()):
        digest.update(f"{name} {leaf.dtype} {leaf.shape}".encode() + leaf.tobytes())
    return np.frombuffer(digest.digest(), np.uint8)


def check_same(path: Path, what: str, held: dict[str, Any], wanted: dict[str, Any], fix: str = ANEW) -> None:
    """Refuses to continue saved work that is not the one asked for.

    Args:
        path: where it is saved.
        what: "a run", for example.
        held: its facts, as JSON types.
        wanted: the facts that they must equal.
        fix: what to do.

    Raises:
        InputError: naming the first fact of `wanted` that differs.
    """
    if (difference := first_difference(held, wanted)) is not None:
        name, there, now = difference
        told = f"{echo(there)} there, {echo(now)} now"
        raise InputError(f"{path}: holds {what} that differs in its {name} ({told}); {fix}.")


def first_difference(held: Any, wanted: Any, name: str = "") -> tuple[str, Any, Any] | None:
    """(path, held, wanted) of the first difference between two JSON values, or None."""
    if isinstance(held, dict) and isinstance(wanted, dict):
        keys = [*wanted, *(key for key in held if key not in wanted)]
        pairs = [(f"{name}.{key}".lstrip("."), held.get(key), wanted.get(key)) for key in keys]
    elif isinstance(held, list) and isinstance(wanted, list) and len(held) == len(wanted):
        pairs = [(f"{name}[{i}]", a, b) for i, (a, b) in enumerate(zip(held, wanted, strict=True))]
    else:
        return None if held == wanted else (name, held, wanted)
    return next((found for path, a, b in pairs if (found := first_difference(a, b, path)) is not None), None)
