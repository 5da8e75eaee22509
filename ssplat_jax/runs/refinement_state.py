"""State of a refinement as a file: all that the next step depends on besides the run and its capture."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import Gaussians, with_sh_degree
from ssplat_jax.core.pytree import replace
from ssplat_jax.refinement import KeyViews, RefineConfig
from ssplat_jax.refinement.present_rows import only_present, present_and_new, present_rows
from ssplat_jax.refinement.refine import Progress
from ssplat_jax.refinement.refine_step import init_refinement
from ssplat_jax.refinement.revision import Revision
from ssplat_jax.storage.files import load_arrays, save_arrays

KIND = "refinement state 2"
COUNTS = ("num_steps", "num_skipped")
MOVING = ("revision", "first_moment", "second_moment")


def save_refinement(path: Path, progress: Progress, key_views: KeyViews, identity: dict) -> None:
    """Saves a refinement, without the scene that it started from and without images: the run and its capture have them.

    Gaussians that were added before the first step are saved as they were then.

    Args:
        path: the file.
        progress: the refinement between two steps.
        key_views: its key views, of which only the mask of the valid ones is saved.
        identity: facts that must be equal for it to be continued.
    """
    state = progress.state
    arrays = {
        f"{part}.{name}": np.asarray(leaf) for part in MOVING for name, leaf in vars(getattr(state, part)).items()
    }
    arrays |= {name: np.asarray(getattr(state, name)) for name in COUNTS}
    arrays["valid"] = np.asarray(key_views.valid)
    if progress.rows is not None and progress.num_new:  # they are in no other file
        new = slice(len(progress.rows) - progress.num_new, len(progress.rows))
        arrays |= {f"new.{name}": np.asarray(leaf[new]) for name, leaf in vars(state.start).items()}
    names = ("max_pairs", "max_rows", "losses", "held_back", "seconds", "num_learned", "num_new")
    measured = {name: getattr(progress, name) for name in names}
    save_arrays(path, arrays, KIND, {"identity": identity, "measured": measured})


def load_refinement(
    path: Path, gaussians: Gaussians, key_views: KeyViews, config: RefineConfig, identity: dict
) -> tuple[Progress, KeyViews]:
    """The refinement of `gaussians` that a file holds, and its key views.

    Args:
        path: the file.
        gaussians: the scene that it started from.
        key_views: the key views of the run, as given.
        config: its configuration.
        identity: facts that the file must agree with.

    Raises:
        InputError: the file holds the refinement of another run, or one with other options.
        StorageError: the file is damaged.
    """
    arrays, header = load_arrays(path, KIND)
    held = dict(header["identity"])
    # Fields that are newer than the file had no effect when it was written, as by default today.
    held["refine_config"] = dataclasses.asdict(RefineConfig()) | held.get("refine_config", {})
    for name, wanted in identity.items():
        if held.get(name) != wanted:
            raise InputError(
                f"{path}: holds a refinement that differs in its {name}; repeat the old options, or start anew with"
                " --overwrite."
            )
    if "valid" in arrays:  # saved before views could be left out: all are valid
        key_views = replace(key_views, valid=jnp.asarray(arrays["valid"]))
    if "new.means" in arrays:
        new = Gaussians(**_below(arrays, "new."))
        given = with_sh_degree(gaussians, new.sh_degree)
        present, rows = present_and_new(given, new, new.num_gaussians)
    else:
        rows = present_rows(gaussians)
        present = only_present(gaussians, rows)
    fresh = init_refinement(present, config)
    moving = {part: Revision(**_below(arrays, f"{part}.")) for part in MOVING}
    state = replace(fresh, **moving, **{name: jnp.asarray(arrays[name]) for name in COUNTS})
    return Progress(state, rows, **header["measured"]), key_views


def _below(arrays: dict[str, np.ndarray], prefix: str) -> dict[str, jax.Array]:
    """Arrays whose name begins with `prefix`, without it."""
    found = {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}
    return {name: jnp.asarray(array) for name, array in found.items() if "." not in name}
