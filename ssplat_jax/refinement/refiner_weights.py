"""Parameters of the learned pass as a file, and those that ship with the package."""

import functools
from importlib import resources
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.model.refiner import Refiner
from ssplat_jax.refinement.learned_pass import no_errors, refiner_features
from ssplat_jax.storage.files import load_arrays, save_arrays

KIND = "refiner"  # kind of the file


def init_refiner(seed: int = 0) -> dict:
    """Parameters before training: every step goes a little against the gradient."""
    return dict(Refiner().init(jax.random.key(seed), jnp.zeros((1, num_features())))["params"])


def num_features() -> int:
    """Number of inputs of the network."""
    one, none = jnp.ones((1, 3)), jnp.zeros(1)
    gaussians = Gaussians(means=one, quats=jnp.ones((1, 4)), scales=one, opacities=none, sh=one[:, None])
    seen = no_errors(gaussians)
    return refiner_features(gaussians, seen, seen.slopes).shape[1]


def save_refiner(path: Path, params: dict, provenance: dict[str, Any]) -> None:
    """Writes the parameters and JSON facts about their training.

    Raises:
        StorageError: the file cannot be written.
    """
    arrays = {
        f"{layer}/{name}": np.asarray(x, np.float32) for layer, part in params.items() for name, x in part.items()
    }
    save_arrays(path, arrays, KIND, {"provenance": provenance})


def load_refiner(path: Path | None = None) -> dict:
    """The parameters in a file; without one, those that ship with the package.

    Raises:
        InputError: the parameters have other shapes than the network.
        StorageError: the file is missing, damaged or of another kind.
    """
    if path is None:
        return _shipped()
    arrays, _ = load_arrays(path, KIND)
    wanted = jax.eval_shape(init_refiner)
    for layer, part in wanted.items():
        for name, x in part.items():
            got = arrays[f"{layer}/{name}"].shape if f"{layer}/{name}" in arrays else "nothing"
            if got != x.shape:
                raise InputError(f"{path}: {layer}/{name} must be {x.shape}, got {got}; train it with this version.")
    return {layer: {name: jnp.asarray(arrays[f"{layer}/{name}"]) for name in part} for layer, part in wanted.items()}


@functools.cache
def _shipped() -> dict:
    with resources.as_file(resources.files("ssplat_jax") / "weights" / "refiner.npz") as path:
        return load_refiner(path)
