"""What a render simulates. Everything here is static: an effect that is off is not in the compiled program."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Array, Float

from ssplat_jax.errors import InputError
from ssplat_jax.gaussians import Gaussians
from ssplat_jax.geometry.cameras import Camera

OUTPUTS = ("color", "alpha", "depth", "median_depth")


@dataclasses.dataclass(frozen=True)
class Effects:
    """The effects of a render, each of which can be left out. Hashable; changing it recompiles."""

    sh_degree: int | None = None
    """SH bands that are evaluated; None takes all that the Gaussians hold."""
    antialias: str = "mip"
    """`mip`: 2D Mip filter (0.1 px^2, opacity compensated); `classic`: 0.3 px^2 dilation; `none`: point sampling."""
    filter_3d: bool = False
    """3D smoothing filter: bounds detail by what the cameras given as `captured` could see (Mip-Splatting)."""
    distortion: bool = False
    """OPENCV radial-tangential lens distortion, coefficients given as `distortion`."""
    exposure: bool = False
    """Affine color correction per frame (exposure, white balance), given as `exposures`."""
    background: Sequence[float] | None = None
    """Color behind the scene; None is black, at no cost."""
    outputs: Sequence[str] = ("color", "alpha", "depth")
    """What is wanted: `color` (always there), `alpha`, `depth`, `median_depth`."""

    def __post_init__(self) -> None:
        if self.sh_degree not in (None, 0, 1, 2, 3):
            raise InputError(f"effects: sh_degree must be None or 0 to 3, got {self.sh_degree!r}.")
        if self.antialias not in ("mip", "classic", "none"):
            raise InputError(f"effects: antialias must be 'mip', 'classic' or 'none', got {self.antialias!r}.")
        if unknown := [name for name in self.outputs if name not in OUTPUTS]:
            raise InputError(f"effects: no output {unknown[0]!r}; there is {', '.join(OUTPUTS)}.")
        # Lists would make the effects unhashable, long after this line.
        object.__setattr__(self, "outputs", tuple(self.outputs))
        if self.background is not None:
            background = tuple(float(c) for c in self.background)
            if len(background) != 3:
                raise InputError(f"effects: background must be three numbers or None, got {len(background)}.")
            object.__setattr__(self, "background", background)

    def replace(self, **changes: Any) -> "Effects":
        """A copy with `changes`."""
        return dataclasses.replace(self, **changes)

    @property
    def needs_alpha(self) -> bool:
        """Whether the transmittance is composited: asked for, or needed by depth or background."""
        return bool({"alpha", "depth"} & set(self.outputs)) or self.background is not None


def effects_for(
    gaussians: Gaussians,
    camera: Camera,
    *,
    captured: Camera | None = None,
    distortion: Float[Array, "*b 5"] | None = None,
    exposures: Float[Array, "*b 3 4"] | None = None,
    outputs: tuple[str, ...] = ("color", "alpha", "depth"),
) -> Effects:
    """The least that shows this scene right from these cameras. Looks at values: call it outside jit.

    SH bands that are zero everywhere are not evaluated; zero distortion coefficients are a pinhole; exposures that are
    the same for all of several frames are none (the scene's colors hold them already); no camera that samples the
    scene at most 1.05 times as finely as the `captured` ones did needs the 3D filter.
    """
    return Effects(
        sh_degree=_used_degree(np.asarray(gaussians.sh, np.float32)),
        filter_3d=captured is not None and _sampling_ratio(gaussians, camera, captured) > 1.05,
        distortion=distortion is not None and bool(np.any(np.asarray(distortion) != 0)),
        exposure=exposures is not None and _differ(np.asarray(exposures)),
        outputs=outputs,
    )


def _used_degree(sh: np.ndarray) -> int:
    """The highest SH band with an entry other than 0."""
    used = np.flatnonzero(np.any(sh != 0, axis=(0, 2)))
    return int(np.sqrt(used[-1])) if used.size else 0


def _differ(exposures: np.ndarray) -> bool:
    flat = exposures.reshape(-1, 12)
    # One frame alone differs from others that are not here, unless its correction is none.
    usual = flat[:1] if len(flat) > 1 else np.eye(3, 4).reshape(1, 12)
    return bool(np.any(np.abs(flat - usual) > 1e-6))


def _sampling_ratio(gaussians: Gaussians, camera: Camera, captured: Camera) -> float:
    """By how much the cameras sample the finest-seen present Gaussians more finely (f / z) than the captured ones."""
    present = np.asarray(gaussians.opacities) > 0
    means = np.asarray(gaussians.means, np.float64)[present]
    ours, theirs = _sampling_rates(means, camera), _sampling_rates(means, captured)
    seen = (ours > 0) & (theirs > 0)
    return float(np.quantile(ours[seen] / theirs[seen], 0.99)) if seen.any() else 0.0


def _sampling_rates(means: np.ndarray, camera: Camera) -> np.ndarray:
    """Pixels per scene unit at each mean in the camera that sees it best; 0 where none does."""
    rates = np.zeros(means.shape[0])
    viewmats = np.asarray(camera.viewmats, np.float64).reshape(-1, 4, 4)
    for viewmat, K in zip(viewmats, np.asarray(camera.Ks, np.float64).reshape(-1, 3, 3), strict=True):
        x, y, z = (means @ viewmat[:3, :3].T + viewmat[:3, 3]).T
        z = np.where(z > 0.01, z, np.inf)
        u, v = K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]
        inside = (u >= 0) & (u <= camera.width) & (v >= 0) & (v <= camera.height)
        rates = np.maximum(rates, np.where(inside, K[0, 0] / z, 0.0))
    return rates
