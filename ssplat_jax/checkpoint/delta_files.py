"""The changes of a growing scene on disk, one `.npz` a chunk; put together in order they are the scene."""

import dataclasses
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from ssplat_jax.gaussians import Gaussians
from ssplat_jax.storage.npz import load_arrays, save_arrays
from ssplat_jax.streaming.scene_delta import SceneDelta

KIND = "scene delta 1"


def save_delta(path: Path, delta: SceneDelta, header: dict[str, Any] | None = None) -> None:
    """Writes one `.npz` (readable with `numpy.load`), atomically, with the JSON-able `header` of the caller.

    Raises:
        StorageError: it could not be written.
    """
    arrays = {field.name: np.asarray(getattr(delta.gaussians, field.name)) for field in dataclasses.fields(Gaussians)}
    save_arrays(path, arrays | {"rows": delta.rows}, KIND, {"capacity": delta.capacity, "caller": header or {}})


def load_delta(path: Path) -> SceneDelta:
    """What `save_delta` wrote.

    Raises:
        StorageError: no such file, or one that is not, bit for bit, what was written.
    """
    arrays, facts = load_arrays(path, KIND)
    rows = arrays.pop("rows")
    return SceneDelta(rows, Gaussians(**{name: jnp.asarray(x) for name, x in arrays.items()}), facts["capacity"])


def load_delta_header(path: Path) -> dict[str, Any]:
    """The header that `save_delta` was given.

    Raises:
        StorageError: as `load_delta`.
    """
    return load_arrays(path, KIND)[1].get("caller", {})
