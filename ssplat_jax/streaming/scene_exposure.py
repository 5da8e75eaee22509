"""The exposure at which a run wrote its scene, and the scene without it: at one exposure, that of the first views."""

import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ssplat_jax.core.errors import refusal
from ssplat_jax.core.gaussians import Gaussians, scale_colors
from ssplat_jax.storage.run_folder import RunFolder


def scene_exposure(scene: Path) -> Float[np.ndarray, "3"]:
    """The RGB factor from the exposure of a run's first views to that of its scene file.

    Args:
        scene: the folder of a run, or its scene.ply or refined.ply.

    Raises:
        InputError: no metrics of a run are beside the scene, or the scene is not one that the run wrote.
    """
    folder = RunFolder(scene if scene.is_dir() else scene.parent)
    is_written = scene.is_dir() or scene.name in (folder.scene.name, folder.refined_scene.name)
    try:
        factors = np.array(json.loads(folder.metrics.read_bytes())["scene_exposure"], np.float64)
        is_known = is_written and factors.shape == (3,) and bool((np.isfinite(factors) & (factors > 0)).all())
    except (OSError, ValueError, TypeError, LookupError):
        is_known = False
    if not is_known:
        got, fix = f"none for {scene}", "give the folder of a finished `ssplat run`, or leave the flag out"
        raise refusal("--one-exposure", wanted="the exposure of the scene in metrics.json", got=got, fix=fix)
    return factors


def at_first_exposure(gaussians: Gaussians, exposure: Float[np.ndarray, "3"]) -> Gaussians:
    """Gaussians of a scene file at the exposure of the first views, as the literal scores show them."""
    return scale_colors(gaussians, jnp.asarray(1.0 / exposure, jnp.float32))
