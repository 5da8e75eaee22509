"""Selection and clamping of the Gaussians that are written to a scene file, common to all formats."""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import Gaussians, check_gaussians

SH_TERMS = (1, 4, 9, 16)
"""Numbers of SH terms that files hold, those of degree 0 to 3."""

MIN_OPACITY = 1.0 / 255.0
"""Gaussians below this opacity are invisible in every renderer and are not written (absent rows have opacity 0)."""

OPACITY_GUARD = 1e-6
"""Opacities are clamped this far from 0 and 1, where the logit is infinite."""

LOG_SCALE_LIMIT = 20.0
"""|ln sigma| is clamped to this, 2e-9 to 5e8 units: the range of the compressed formats that are made from a .ply."""


@dataclasses.dataclass(frozen=True)
class ExportReport:
    """Counts of written and dropped Gaussians, and the offset of the positions in the file."""

    num_written: int
    num_dropped: int
    """Gaussians with non-finite entries, a negative scale, or an opacity below 1/255 (absent rows included)."""
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Vector to add to the positions in the file."""
    num_pruned: int = 0
    """Specks and floaters left out on demand (`select_gaussians.prune_mask`)."""
    num_cut: int = 0
    """Gaussians left out because there were more than wanted."""

    @property
    def warning(self) -> str | None:
        """Note for the user who opens the file, or None."""
        far = "the capture lies far from its origin; positions are counted from"
        return f"{far} {[float(x) for x in self.offset]}." if any(self.offset) else None


@dataclasses.dataclass(frozen=True)
class SceneRows:
    """Gaussians to write, float64, in their order in the scene."""

    means: Float64[np.ndarray, "n 3"]
    quats: Float64[np.ndarray, "n 4"]  # wxyz, unit
    log_scales: Float64[np.ndarray, "n 3"]
    opacities: Float64[np.ndarray, " n"]  # inside (0, 1)
    sh: Float64[np.ndarray, "n k 3"]

    def __len__(self) -> int:
        return len(self.means)


def scene_rows(gaussians: Gaussians) -> SceneRows:
    """Returns the visible Gaussians, with every entry in the range that files can hold.

    Limits:
        Gaussians with a non-finite entry, a negative scale or an opacity below 1/255 are dropped.
        Opacities are clamped to [1e-6, 1 - 1e-6], scales to [e^-20, e^20]; a zero quaternion becomes the identity.

    Raises:
        InputError: an array of the scene has a wrong shape, or the number of SH terms is none of 1, 4, 9 and 16.
    """
    check_gaussians(gaussians, "scene")
    if (terms := gaussians.sh.shape[1]) not in SH_TERMS:
        raise InputError(f"scene: sh must hold 1, 4, 9 or 16 terms for each Gaussian, got {terms}.")
    fields = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
    means, quats, scales, opacities, sh = (np.asarray(field, np.float64) for field in fields)
    keep = is_writable(gaussians)
    return SceneRows(
        means=means[keep],
        quats=unit_quats(quats[keep]),
        log_scales=np.log(np.clip(scales[keep], np.exp(-LOG_SCALE_LIMIT), np.exp(LOG_SCALE_LIMIT))),
        opacities=np.clip(opacities[keep], OPACITY_GUARD, 1 - OPACITY_GUARD),
        sh=sh[keep],
    )


def is_writable(gaussians: Gaussians) -> Bool[np.ndarray, " n"]:
    """Mask of the Gaussians that files hold: finite, without a negative scale, with an opacity of at least 1/255."""
    fields = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
    means, quats, scales, opacities, sh = (np.asarray(field, np.float64) for field in fields)
    entries = np.concatenate([means, quats, scales, opacities[:, None], sh.reshape(len(sh), 3 * sh.shape[1])], axis=1)
    return np.isfinite(entries).all(axis=1) & (scales >= 0).all(axis=1) & (opacities >= MIN_OPACITY)


def unit_quats(quats: Float64[np.ndarray, "n 4"]) -> Float64[np.ndarray, "n 4"]:
    """Normalizes quaternions; those with all entries within 1e-12 of 0 become the identity, as in the renderer."""
    largest = np.abs(quats).max(axis=1, keepdims=True, initial=0.0)
    quats = np.where(largest > 1e-12, quats, np.array([1.0, 0.0, 0.0, 0.0]))
    quats = quats / np.abs(quats).max(axis=1, keepdims=True, initial=0.0)
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


def to_bytes(values: Float64[np.ndarray, "*n"]) -> UInt8[np.ndarray, "*n"]:
    """Rounds to the nearest integer in [0, 255]."""
    return np.clip(np.round(values), 0, 255).astype(np.uint8)
