"""Scene deltas on disk, one `.npz` per chunk; applied in order they give the scene."""

import dataclasses
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.storage.npz import load_arrays, save_arrays
from ssplat_jax.streaming.scene_delta import SceneDelta

KIND = "scene delta 1"  # kind and version of the file


def save_delta(path: Path, delta: SceneDelta, header: dict[str, Any] | None = None) -> None:
    """Writes one delta and the caller's JSON-serializable `header` to an `.npz` file, atomically.

    Raises:
        StorageError: the file cannot be written.
    """
    arrays = {field.name: np.asarray(getattr(delta.gaussians, field.name)) for field in dataclasses.fields(Gaussians)}
    arrays |= {"rows": delta.rows, "confidences": delta.confidences}
    save_arrays(path, arrays, KIND, {"capacity": delta.capacity, "caller": header or {}})


def load_delta(path: Path) -> SceneDelta:
    """Reads a delta that `save_delta` wrote.

    Raises:
        StorageError: the file is missing, of another kind, or damaged.
    """
    arrays, facts = load_arrays(path, KIND)
    rows, confidences = arrays.pop("rows"), arrays.pop("confidences")
    gaussians = Gaussians(**{name: jnp.asarray(x) for name, x in arrays.items()})
    return SceneDelta(rows, gaussians, facts["capacity"], confidences)


def load_delta_header(path: Path) -> dict[str, Any]:
    """Reads the caller's header of a delta; empty if the file has none.

    Raises:
        StorageError: the file is missing, of another kind, or damaged.
    """
    return load_arrays(path, KIND)[1].get("caller", {})
