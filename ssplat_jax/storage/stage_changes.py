"""Distance of each stage from its random start."""

import dataclasses
import math

import jax
import numpy as np

from ssplat_jax.config import StreamConfig
from ssplat_jax.model import init_params


@dataclasses.dataclass(frozen=True)
class StageChange:
    """Change of one stage's parameters, all taken as one vector."""

    name: str
    num_params: int
    distance: float  # |params - start| / |start|
    turn: float  # sine of the angle between params and start: weight decay alone shrinks them and does not turn them


def start_of(config: StreamConfig, provenance: dict) -> dict:
    """The random parameters that stages began with: those of the first training, or of the one that added a stage.

    Args:
        config: configuration of the model.
        provenance: of a weights file that `ssplat train` wrote; without a seed, seed 0 is taken.
    """
    first, *later = trainings(provenance)
    start = init_params(jax.random.key(_seed_of(first)), config)
    for training in later:
        if added := [name for name in training.get("fresh", ()) if name in start]:
            start |= init_params(jax.random.key(_seed_of(training)), config, only=added)
    return start


def trainings(provenance: dict) -> list[dict]:
    """The provenance of each training, or import, that led to weights, the first one first."""
    found = [provenance]
    while isinstance(before := found[0].get("before"), dict):
        found.insert(0, before)
    return found


def _seed_of(provenance: dict) -> int:
    """The recipe's seed; 0 if it holds none."""
    recipe = provenance.get("recipe")
    return recipe.get("seed", 0) if isinstance(recipe, dict) else 0


def stage_changes(params: dict, start: dict) -> list[StageChange]:
    """Change of every stage of `start`, in their order; stages without parameters are left out.

    Limits:
        Stages that start at zero: the distance is 0 if they stayed there, else infinite; the turn is 0 or 1.
    """
    changes = []
    for name, part in start.items():
        before, after = _vector(part), _vector(params[name])
        if before.size:
            changes.append(_change(name, before, after))
    return changes


def _change(name: str, before: np.ndarray, after: np.ndarray) -> StageChange:
    """The change of one stage from `before` to `after`."""
    length, moved = float(np.linalg.norm(before)), float(np.linalg.norm(after - before))
    if length == 0:
        return StageChange(name, before.size, math.inf if moved else 0.0, float(moved > 0))
    # The part of `after` that is perpendicular to the start: exact for small angles, where 1 - cos^2 would cancel.
    across = float(np.linalg.norm(after - (after @ before) / length**2 * before))
    return StageChange(name, before.size, moved / length, across / max(float(np.linalg.norm(after)), 1e-300))


def _vector(params: dict) -> np.ndarray:
    """All parameters of a stage in one float64 vector."""
    leaves = [np.asarray(leaf, np.float64).reshape(-1) for leaf in jax.tree.leaves(params)]
    return np.concatenate(leaves) if leaves else np.zeros(0)
