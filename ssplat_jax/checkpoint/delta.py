"""The changes of a growing scene on disk, one `.npz` a chunk; put together in order they are the scene."""

import dataclasses
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from ssplat_jax.checkpoint.arrays import load_arrays, save_arrays
from ssplat_jax.follow import SceneDelta
from ssplat_jax.gaussians import Gaussians

KIND = "scene delta 1"


def save_delta(path: Path, delta: SceneDelta) -> None:
    """Writes one `.npz` (readable with `numpy.load`), atomically.

    Raises:
        StorageError: it could not be written.
    """
    arrays = {field.name: np.asarray(getattr(delta.gaussians, field.name)) for field in dataclasses.fields(Gaussians)}
    save_arrays(path, arrays | {"rows": delta.rows}, KIND, {"capacity": delta.capacity})


def load_delta(path: Path) -> SceneDelta:
    """What `save_delta` wrote.

    Raises:
        StorageError: no such file, or one that is not, bit for bit, what was written.
    """
    arrays, facts = load_arrays(path, KIND)
    rows = arrays.pop("rows")
    return SceneDelta(rows, Gaussians(**{name: jnp.asarray(x) for name, x in arrays.items()}), facts["capacity"])
