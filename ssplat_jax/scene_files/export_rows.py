"""What goes into a scene file, whatever its format: the Gaussians that can be seen, in numbers that a file can hold."""

import dataclasses

import numpy as np
from jaxtyping import Float64, UInt8

from ssplat_jax.gaussians import Gaussians

MIN_OPACITY = 1.0 / 255.0
"""Rows fainter than this draw nothing in any renderer and are not written; absent rows (opacity 0) are among them."""

OPACITY_GUARD = 1e-6
"""Opacities are written no nearer than this to 0 and 1, where the logit is infinite."""

LOG_SCALE_LIMIT = 20.0
"""|ln sigma| beyond this is clamped: 2e-9 to 5e8 units, the range of the compressed formats made from such a file."""


@dataclasses.dataclass(frozen=True)
class ExportReport:
    """What became of the rows of a scene."""

    num_written: int
    num_dropped: int
    """Non-finite, of negative scale, or fainter than 1/255 (absent rows included)."""
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """To be added to the file's positions."""

    @property
    def warning(self) -> str | None:
        """What whoever opens the file should know."""
        far = "the capture lies far from its origin; positions are counted from"
        return f"{far} {list(self.offset)}." if any(self.offset) else None


@dataclasses.dataclass(frozen=True)
class SceneRows:
    """The Gaussians to be written, in their order."""

    means: Float64[np.ndarray, "n 3"]
    quats: Float64[np.ndarray, "n 4"]  # wxyz, unit
    log_scales: Float64[np.ndarray, "n 3"]
    opacities: Float64[np.ndarray, " n"]  # inside (0, 1)
    sh: Float64[np.ndarray, "n k 3"]

    def __len__(self) -> int:
        return len(self.means)


def scene_rows(gaussians: Gaussians) -> SceneRows:
    """The rows worth writing.

    Limits:
        Rows with an entry that is not finite, a negative scale or an opacity below 1/255 are left out.
        Opacities are clamped to [1e-6, 1 - 1e-6], scales to [e^-20, e^20]; a zero quaternion becomes the identity.
    """
    fields = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
    means, quats, scales, opacities, sh = (np.asarray(field, np.float64) for field in fields)
    entries = np.concatenate([means, quats, scales, opacities[:, None], sh.reshape(len(sh), 3 * sh.shape[1])], axis=1)
    keep = np.isfinite(entries).all(axis=1) & (scales >= 0).all(axis=1) & (opacities >= MIN_OPACITY)
    return SceneRows(
        means=means[keep],
        quats=unit_quats(quats[keep]),
        log_scales=np.log(np.clip(scales[keep], np.exp(-LOG_SCALE_LIMIT), np.exp(LOG_SCALE_LIMIT))),
        opacities=np.clip(opacities[keep], OPACITY_GUARD, 1 - OPACITY_GUARD),
        sh=sh[keep],
    )


def unit_quats(quats: Float64[np.ndarray, "n 4"]) -> Float64[np.ndarray, "n 4"]:
    """Unit quaternions; the identity for those the renderer takes as one (all entries within 1e-12 of 0)."""
    largest = np.abs(quats).max(axis=1, keepdims=True, initial=0.0)
    quats = np.where(largest > 1e-12, quats, np.array([1.0, 0.0, 0.0, 0.0]))
    quats = quats / np.abs(quats).max(axis=1, keepdims=True, initial=0.0)
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


def to_bytes(values: Float64[np.ndarray, "*n"]) -> UInt8[np.ndarray, "*n"]:
    """To the nearest of 0 .. 255."""
    return np.clip(np.round(values), 0, 255).astype(np.uint8)
