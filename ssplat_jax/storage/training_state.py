"""Training checkpoints, saved with Orbax; the recipe is stored beside them, so that another run cannot resume them.

Orbax does not detect flipped bits in an array, so every checkpoint holds the sha256 of its leaves.
"""

import hashlib
import itertools
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp

from ssplat_jax.core.atomic import write_atomic
from ssplat_jax.core.errors import InputError, StorageError
from ssplat_jax.storage.saved_config import config_from_header

RECIPE_FILE = "recipe.json"  # holds the description of the run
DIGEST = "sha256"  # name of the digest among the leaves, which are numbered


def first_difference(held: Any, wanted: Any, name: str = "") -> tuple[str, Any, Any] | None:
    """Returns (path, held, wanted) of the first difference between two JSON values, or None."""
    if isinstance(held, dict) and isinstance(wanted, dict):
        pairs = [(f"{name}.{k}".lstrip("."), held.get(k), wanted.get(k)) for k in sorted(held.keys() | wanted.keys())]
    elif isinstance(held, list) and isinstance(wanted, list) and len(held) == len(wanted):
        pairs = [(f"{name}[{i}]", a, b) for i, (a, b) in enumerate(zip(held, wanted, strict=True))]
    else:
        return None if held == wanted else (name, held, wanted)
    return next((found for path, a, b in pairs if (found := first_difference(a, b, path)) is not None), None)


class TrainingCheckpoints:
    """Saves and restores training states in a directory; the last two are kept.

    Args:
        directory: created if missing.
        description: JSON-serializable facts that determine the run, such as the recipe and the model configuration. A
            directory with another description is refused.
        upgrade: adds the fields that earlier versions did not write to the description in the directory.

    Raises:
        InputError: the directory holds another run.
        StorageError: its recipe.json is damaged.
    """

    def __init__(
        self, directory: Path, description: dict, upgrade: Callable[[dict], dict] = lambda description: description
    ) -> None:
        self.directory = Path(directory).resolve()
        self.directory.mkdir(parents=True, exist_ok=True)
        self._claim(json.loads(json.dumps(description)), upgrade)
        options = ocp.CheckpointManagerOptions(max_to_keep=2, create=True, enable_async_checkpointing=False)
        self._manager = ocp.CheckpointManager(self.directory / "checkpoints", options=options)

    def _claim(self, description: dict, upgrade: Callable[[dict], dict]) -> None:
        """Writes the description into a new directory, or compares it with that of an existing one."""
        path = self.directory / RECIPE_FILE
        if not path.exists():
            write_atomic(path, json.dumps(description, indent=1, sort_keys=True).encode())
            return
        try:
            held_description = json.loads(path.read_text())
            if "chunk_size" in held_description.get("config", {}):  # flat, as before 0.1.0
                held_description["config"] = config_from_header(held_description["config"]).to_dict()
            held_description = upgrade(held_description)
        except InputError:
            raise
        except (ValueError, LookupError, TypeError, AttributeError) as error:
            raise StorageError(f"{path}: damaged; restore it or choose another --out.") from error
        if (found := first_difference(held_description, description)) is not None:
            name, held, wanted = found
            raise InputError(
                f"{path}: this directory holds a run with {name} = {held!r}, wanted {wanted!r}; choose another --out,"
                " or repeat the old options with the old files."
            )

    def save(self, step: int, state) -> None:
        """Saves `state` as checkpoint `step`; returns when it is on disk.

        Raises:
            StorageError: it cannot be written.
        """
        leaves = {f"{i:04d}": np.asarray(leaf) for i, leaf in enumerate(jax.tree.leaves(state))}
        leaves[DIGEST] = _digest(leaves)
        try:
            self._manager.save(step, args=ocp.args.StandardSave(leaves))
            self._manager.wait_until_finished()
        except (OSError, ValueError) as error:
            raise StorageError(f"{self.directory}: could not save step {step}: {error}") from error

    def restore_latest(self, like, warn: Callable[[str], None]):
        """Returns (step, state) of the newest intact checkpoint, or None if there is no checkpoint.

        Newer, damaged checkpoints are renamed to `damaged-<step>`, or `damaged-<step>-2` if that exists, and so on.

        Args:
            like: a state of the same structure, shapes and types.
            warn: called with a message for each damaged checkpoint.

        Raises:
            StorageError: all checkpoints are damaged; they are left in place.
        """
        steps = sorted(self._manager.all_steps(), reverse=True)
        for number, step in enumerate(steps):
            if (state := self._restore(step, like)) is None:
                continue
            for damaged in steps[:number]:
                warn(f"{self.directory}: checkpoint {damaged} is damaged; continuing from step {step}.")
                os.replace(self._manager.directory / str(damaged), self._free_name(f"damaged-{damaged}"))
            self._manager.reload()
            return step, state
        if steps:
            found = ", ".join(map(str, steps))
            raise StorageError(
                f"{self.directory}: checkpoints {found} are damaged or of another version; choose another --out."
            )
        return None

    def _free_name(self, name: str) -> Path:
        """A path in the directory that does not exist: `name`, or with the first free number."""
        names = itertools.chain([name], (f"{name}-{number}" for number in itertools.count(2)))
        return next(path for path in map(self.directory.joinpath, names) if not path.exists())

    def _restore(self, step: int, like):
        """State of checkpoint `step`, or None if it is damaged."""
        leaves, treedef = jax.tree.flatten(like)
        abstract = {f"{i:04d}": jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for i, leaf in enumerate(leaves)}
        abstract[DIGEST] = jax.ShapeDtypeStruct((32,), np.uint8)
        try:
            held = self._manager.restore(step, args=ocp.args.StandardRestore(abstract))
        except Exception:  # a damaged checkpoint can make Orbax raise anything
            return None
        arrays = {name: np.asarray(leaf) for name, leaf in held.items()}
        if not np.array_equal(arrays.pop(DIGEST), _digest(arrays)):
            return None
        return jax.tree.unflatten(treedef, [jax.numpy.asarray(arrays[f"{i:04d}"]) for i in range(len(leaves))])

    def close(self) -> None:
        """Releases the manager's threads."""
        self._manager.close()


def _digest(leaves: dict[str, np.ndarray]) -> np.ndarray:
    """sha256 of the names, types, shapes and values of the leaves, as 32 bytes."""
    digest = hashlib.sha256()
    for name, leaf in sorted(leaves.items()):
        digest.update(f"{name} {leaf.dtype} {leaf.shape}".encode())
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return np.frombuffer(digest.digest(), np.uint8)
