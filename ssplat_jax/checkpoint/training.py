"""Training checkpoints: an Orbax manager over plain dicts, with the recipe beside them so that a resume can refuse."""

import json
from pathlib import Path

import jax
import numpy as np
import orbax.checkpoint as ocp

from ssplat_jax.errors import InputError, StorageError
from ssplat_jax.export.atomic import write_atomic

RECIPE_FILE = "recipe.json"


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
        held = json.loads(path.read_text())
        for name in sorted(held.keys() | description.keys()):
            if held.get(name) != description.get(name):
                raise InputError(
                    f"{path}: this directory holds a run with {name} = {held.get(name)!r}, wanted"
                    f" {description.get(name)!r}; choose another --out or repeat the old options."
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
