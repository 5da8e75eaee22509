"""Training checkpoints: an Orbax manager over plain dicts, with the recipe beside them so that a resume can refuse.

Orbax reads an array with a flipped bit without complaint, so every checkpoint holds the sha256 of its leaves.
"""

import hashlib
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp

from ssplat_jax.errors import InputError, StorageError
from ssplat_jax.storage.atomic import write_atomic

RECIPE_FILE = "recipe.json"
DIGEST = "sha256"  # the leaf beside the state's own, which are numbered


def first_difference(held: Any, wanted: Any, name: str = "") -> tuple[str, Any, Any] | None:
    """(path, held, wanted) of the first place where two JSON values differ, or None."""
    if isinstance(held, dict) and isinstance(wanted, dict):
        pairs = [(f"{name}.{k}".lstrip("."), held.get(k), wanted.get(k)) for k in sorted(held.keys() | wanted.keys())]
    elif isinstance(held, list) and isinstance(wanted, list) and len(held) == len(wanted):
        pairs = [(f"{name}[{i}]", a, b) for i, (a, b) in enumerate(zip(held, wanted, strict=True))]
    else:
        return None if held == wanted else (name, held, wanted)
    return next((found for path, a, b in pairs if (found := first_difference(a, b, path)) is not None), None)


class TrainingCheckpoints:
    """Saves and restores training states under `directory`; keeps the last two.

    Args:
        directory: created if absent.
        description: JSON-able facts that decide the run (recipe, model configuration). A directory that holds a run
            of another description is refused.

    Raises:
        InputError: the directory holds another run.
    """

    def __init__(self, directory: Path, description: dict) -> None:
        self.directory = Path(directory).resolve()
        self.directory.mkdir(parents=True, exist_ok=True)
        self._claim(json.loads(json.dumps(description)))
        options = ocp.CheckpointManagerOptions(max_to_keep=2, create=True, enable_async_checkpointing=False)
        self._manager = ocp.CheckpointManager(self.directory / "checkpoints", options=options)

    def _claim(self, description: dict) -> None:
        path = self.directory / RECIPE_FILE
        if not path.exists():
            write_atomic(path, json.dumps(description, indent=1, sort_keys=True).encode())
            return
        if (found := first_difference(json.loads(path.read_text()), description)) is not None:
            name, held, wanted = found
            raise InputError(
                f"{path}: this directory holds a run with {name} = {held!r}, wanted {wanted!r}; choose another --out"
                " or repeat the old options."
            )

    def save(self, step: int, state) -> None:
        """Writes `state` as `step`; returns when it is on disk."""
        leaves = {f"{i:04d}": np.asarray(leaf) for i, leaf in enumerate(jax.tree.leaves(state))}
        leaves[DIGEST] = _digest(leaves)
        try:
            self._manager.save(step, args=ocp.args.StandardSave(leaves))
            self._manager.wait_until_finished()
        except (OSError, ValueError) as error:
            raise StorageError(f"{self.directory}: could not save step {step}: {error}") from error

    def restore_latest(self, like, warn: Callable[[str], None]):
        """(step, state) of the newest checkpoint that is whole, shaped as `like`; None where there is none.

        Damaged ones are put aside as `damaged-<step>`, which `warn` is told.

        Raises:
            StorageError: all are damaged; they stay where they are.
        """
        steps = sorted(self._manager.all_steps(), reverse=True)
        for number, step in enumerate(steps):
            if (state := self._restore(step, like)) is None:
                continue
            for damaged in steps[:number]:
                warn(f"{self.directory}: checkpoint {damaged} is damaged; going on from that of step {step}.")
                aside = self.directory / f"damaged-{damaged}"
                os.replace(self._manager.directory / str(damaged), aside)
            self._manager.reload()
            return step, state
        if steps:
            found = ", ".join(map(str, steps))
            raise StorageError(
                f"{self.directory}: checkpoints {found} are damaged or of another version; choose another --out."
            )
        return None

    def _restore(self, step: int, like):
        """The state of `step`, or None if it cannot be read or is not what was saved."""
        leaves, treedef = jax.tree.flatten(like)
        abstract = {f"{i:04d}": jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for i, leaf in enumerate(leaves)}
        abstract[DIGEST] = jax.ShapeDtypeStruct((32,), np.uint8)
        try:
            held = self._manager.restore(step, args=ocp.args.StandardRestore(abstract))
        except Exception:  # Orbax raises whatever the damaged part makes it stumble over
            return None
        arrays = {name: np.asarray(leaf) for name, leaf in held.items()}
        if not np.array_equal(arrays.pop(DIGEST), _digest(arrays)):
            return None
        return jax.tree.unflatten(treedef, [jax.numpy.asarray(arrays[f"{i:04d}"]) for i in range(len(leaves))])

    def close(self) -> None:
        """Releases the manager's threads."""
        self._manager.close()


def _digest(leaves: dict[str, np.ndarray]) -> np.ndarray:
    """sha256 of names, types, shapes and values, as 32 bytes."""
    digest = hashlib.sha256()
    for name, leaf in sorted(leaves.items()):
        digest.update(f"{name} {leaf.dtype} {leaf.shape}".encode())
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return np.frombuffer(digest.digest(), np.uint8)
