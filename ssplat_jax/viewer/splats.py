"""Gaussians as viser takes them.

viser stores covariances as 16-bit floats, in which a Gaussian of 1e-4 units vanishes. Gaussians are therefore sent in
units of the scene's median Gaussian, colored by the constant band of their spherical harmonics.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ssplat_jax.core.gaussians import SH_C0, Gaussians
from ssplat_jax.core.rotations import quats_to_matrices
from ssplat_jax.scene_files.splat_rows import MIN_OPACITY

MAX_SIGMA = 250.0
"""Largest standard deviation that is sent: the square of 256 overflows a 16-bit float."""


@dataclasses.dataclass(frozen=True)
class Splats:
    """Arguments of viser, lengths divided by `unit`."""

    centers: Float[np.ndarray, "n 3"]
    covariances: Float[np.ndarray, "n 3 3"]
    rgbs: Float[np.ndarray, "n 3"]
    opacities: Float[np.ndarray, "n 1"]


def median_size(gaussians: Gaussians) -> float:
    """Median of the largest standard deviations of the visible Gaussians; 1 if there are none."""
    scales = np.asarray(gaussians.scales, np.float64).max(axis=1, initial=0.0)[_is_visible(gaussians)]
    size = float(np.median(scales)) if len(scales) else 0.0
    return size if size > 0 else 1.0


def visible_splats(gaussians: Gaussians, unit: float, max_gaussians: int) -> Splats:
    """The visible Gaussians in units of `unit`.

    If there are more than `max_gaussians`, an evenly spaced selection is taken, the same one each time. Its Gaussians
    are enlarged until they cover the area that all of them did; otherwise surfaces would show holes.

    Limits:
        Standard deviations are cut at 250 units. Rows with a non-finite entry or an opacity below 1/255 are dropped.
    """
    rows, growth = np.flatnonzero(_is_visible(gaussians)), 1.0
    if len(rows) > max_gaussians:
        growth = np.sqrt(len(rows) / max_gaussians)
        rows = rows[np.linspace(0, len(rows) - 1, max_gaussians).round().astype(int)]
    means, quats, scales, opacities, dc = (
        np.asarray(x)[rows]
        for x in (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh[:, 0])
    )
    sigmas = np.clip(growth * scales / unit, 0.0, MAX_SIGMA)
    axes = np.asarray(quats_to_matrices(jnp.asarray(quats))) * sigmas[:, None, :]
    return Splats(
        centers=(means / unit).astype(np.float32),
        covariances=np.einsum("nij,nkj->nik", axes, axes).astype(np.float32),
        rgbs=np.clip(0.5 + SH_C0 * dc, 0.0, 1.0).astype(np.float32),
        opacities=opacities[:, None].astype(np.float32),
    )


def _is_visible(gaussians: Gaussians) -> np.ndarray:
    """Mask of the rows that can be drawn and seen."""
    fields = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.sh[:, 0])
    finite = np.all([np.isfinite(np.asarray(x)).all(axis=1) for x in fields], axis=0)
    return finite & (np.asarray(gaussians.opacities) >= MIN_OPACITY)
