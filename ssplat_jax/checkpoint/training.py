"""Training checkpoints: an Orbax manager over plain dicts, with the recipe beside them so that a resume can refuse."""

import json
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp

from ssplat_jax.errors import InputError, StorageError
from ssplat_jax.export.atomic import write_atomic

RECIPE_FILE = "recipe.json"


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
        try:
            self._manager.save(step, args=ocp.args.StandardSave(leaves))
            self._manager.wait_until_finished()
        except (OSError, ValueError) as error:
            raise StorageError(f"{self.directory}: could not save step {step}: {error}") from error

    def restore_latest(self, like):
        """(step, state) of the newest checkpoint, shaped as `like`; None where there is none."""
        step = self._manager.latest_step()
        if step is None:
            return None
        leaves, treedef = jax.tree.flatten(like)
        abstract = {f"{i:04d}": jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for i, leaf in enumerate(leaves)}
        try:
            held = self._manager.restore(step, args=ocp.args.StandardRestore(abstract))
        except (OSError, ValueError, KeyError) as error:
            raise StorageError(f"{self.directory}: checkpoint {step} cannot be read: {error}") from error
        return step, jax.tree.unflatten(treedef, [jax.numpy.asarray(held[f"{i:04d}"]) for i in range(len(leaves))])

    def close(self) -> None:
        """Releases the manager's threads."""
        self._manager.close()
