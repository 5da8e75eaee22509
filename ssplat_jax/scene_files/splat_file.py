"""`SplatFile`: the contents of a scene file, and the checks that every reader shares."""

import dataclasses
import os
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Float64

from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.scene_files.export_rows import LOG_SCALE_LIMIT, unit_quats


@dataclasses.dataclass(frozen=True)
class SplatFile:
    """Contents of a scene file: the Gaussians and the facts beside them."""

    gaussians: Gaussians
    render_mode: str
    """Renderer that the scene was made for: "default" (3DGS), "mip" (with the 2D Mip filter, as ours), or "2dgs"."""
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Vector to add to the positions."""


def read_scene_bytes(path: str | os.PathLike, wanted: str) -> bytes:
    """The bytes of a scene file.

    Raises:
        InputError: the file cannot be read; `wanted` names its kind.
    """
    try:
        return Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"{path}: wanted {wanted}, it cannot be read ({error.strerror}); check the path.") from error


def widened(values: np.ndarray) -> np.ndarray:
    """Numbers of a file in float64, without NumPy's warning of NaNs, which are refused by what they mean."""
    with np.errstate(invalid="ignore"):
        return values.astype(np.float64)


def gaussians_of_columns(
    path: str | os.PathLike,
    *,
    means: Float[np.ndarray, "n 3"],
    quats: Float[np.ndarray, "n 4"],
    log_scales: Float[np.ndarray, "n 3"],
    opacities: Float[np.ndarray, " n"],
    sh: Float[np.ndarray, "n k 3"],
) -> Gaussians:
    """Gaussians of the decoded columns of a file.

    Args:
        path: the file, for messages.
        means: positions.
        quats: quaternions wxyz of any length; they are normalized, a zero one becomes the identity.
        log_scales: ln of the standard deviations; clamped to [-20, 20].
        opacities: in [0, 1].
        sh: coefficients of the spherical harmonics.

    Raises:
        InputError: an entry is not finite in float32.
    """
    columns: dict[str, Float64[np.ndarray, "*s"]] = {
        "position": means,
        "rotation": quats,
        "scale": log_scales,
        "opacity": opacities,
        "color": sh,
    }
    for name, column in columns.items():
        bad = ~(np.abs(column) <= np.finfo(np.float32).max)
        if bad.any():
            raise InputError(
                f"{path}: Gaussian {int(np.argwhere(bad)[0, 0])}: wanted a finite {name}, got"
                f" {column[bad].flat[0]}; write the file again."
            )
    fields = {
        "means": means,
        "quats": unit_quats(np.asarray(quats, np.float64)),
        "scales": np.exp(np.clip(log_scales, -LOG_SCALE_LIMIT, LOG_SCALE_LIMIT)),
        "opacities": np.clip(opacities, 0.0, 1.0),
        "sh": sh,
    }
    return Gaussians(**{name: jnp.asarray(field, jnp.float32) for name, field in fields.items()})
