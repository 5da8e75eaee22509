"""State of a refinement as a file: all that the next step depends on besides the run and its capture."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from ssplat_jax.core.errors import InputError
from ssplat_jax.refinement.refine import Progress
from ssplat_jax.storage.files import load_arrays, save_arrays

KIND = "refinement state 1"
MEASURED = tuple(field.name for field in dataclasses.fields(Progress) if field.name != "state")


def save_refinement(path: Path, progress: Progress, identity: dict) -> None:
    """Saves a refinement, without the scene that it started from and without images: `start_refinement` finds them
    again from the run and its capture.

    Args:
        path: the file.
        progress: the refinement between two steps.
        identity: facts that must be equal for it to be continued.
    """
    arrays = {name: np.asarray(leaf) for name, leaf in _moving(progress).items()}
    measured = {name: getattr(progress, name) for name in MEASURED}
    save_arrays(path, arrays, KIND, {"identity": identity, "measured": measured})


def load_refinement(path: Path, progress: Progress, identity: dict) -> None:
    """Puts the refinement that a file holds into `progress`, the same refinement before its first step.

    Args:
        path: the file.
        progress: as `start_refinement` gave it.
        identity: facts that the file must agree with.

    Raises:
        InputError: the file holds the refinement of another run, or one with other options.
        StorageError: the file is damaged.
    """
    arrays, header = load_arrays(path, KIND)
    for name, wanted in identity.items():
        if header["identity"].get(name) != wanted:
            raise InputError(
                f"{path}: holds a refinement that differs in its {name}; repeat the old options, or start anew with"
                " --overwrite."
            )
    start = progress.state.start
    moving = [jnp.asarray(arrays[name]) for name in _moving(progress)]
    structure = jax.tree.structure(dataclasses.replace(progress.state, start=None))
    progress.state = dataclasses.replace(jax.tree.unflatten(structure, moving), start=start)
    for name in MEASURED:
        setattr(progress, name, header["measured"][name])


def _moving(progress: Progress) -> dict[str, jax.Array]:
    """The arrays that steps change, by name."""
    leaves = jax.tree.leaves_with_path(progress.state)
    return {name: leaf for path, leaf in leaves if not (name := jax.tree_util.keystr(path)).startswith(".start")}
