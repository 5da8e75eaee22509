"""The effects of a render. All are static: an effect that is off adds no operation to the compiled program."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Array, Float

from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.rasterizer import constants

OUTPUTS = ("color", "alpha", "depth", "median_depth")

NEEDED_ARRAYS = {"filter_3d": "captured", "distortion": "distortion", "exposure": "exposures"}
"""The fields of `Effects` that need an array, and the argument of `render` that holds it."""

FINER_SAMPLING = 1.05
"""A camera calls for the 3D filter when it samples the scene more than this times as finely as the captured ones."""


@dataclasses.dataclass(frozen=True)
class Effects:
    """The effects of a render. Hashable; changing one recompiles.

    An effect that needs an array is on if `render` is given that array. True asks for the array and False forbids it:
    `render` refuses a contradiction.
    """

    sh_degree: int | None = None
    """Highest SH band to evaluate; None takes all that the Gaussians hold."""
    antialias: str = "mip"
    """`mip`: 2D Mip filter (0.1 px^2, opacity compensated); `classic`: 0.3 px^2 dilation; `none`: point sampling."""
    filter_3d: bool | None = None
    """3D smoothing filter: limits detail to what the cameras `captured` could see (Mip-Splatting)."""
    distortion: bool | None = None
    """OPENCV radial-tangential lens distortion with the coefficients `distortion`."""
    exposure: bool | None = None
    """Affine color correction of each frame by `exposures` (exposure, white balance)."""
    background: Sequence[float] | None = None
    """Color behind the scene; None is black, at no cost."""
    outputs: Sequence[str] = ("color", "alpha", "depth")
    """The outputs to compute, of `color` (always computed), `alpha`, `depth` and `median_depth`."""

    def __post_init__(self) -> None:
        if self.sh_degree not in (None, 0, 1, 2, 3):
            raise InputError(f"effects: sh_degree must be None or 0 to 3, got {self.sh_degree!r}.")
        if self.antialias not in ("mip", "classic", "none"):
            raise InputError(f"effects: antialias must be 'mip', 'classic' or 'none', got {self.antialias!r}.")
        for name in NEEDED_ARRAYS:
            if not isinstance(flag := getattr(self, name), bool | None):
                raise InputError(f"effects: {name} must be True, False or None, got {flag!r}.")
        if unknown := [name for name in self.outputs if name not in OUTPUTS]:
            raise InputError(f"effects: outputs must be among {', '.join(OUTPUTS)}, got {unknown[0]!r}.")
        # A list would make the effects unhashable, which shows only later.
        object.__setattr__(self, "outputs", tuple(self.outputs))
        if self.background is not None:
            background = tuple(float(c) for c in self.background)
            if len(background) != 3:
                raise InputError(f"effects: background must be three numbers or None, got {len(background)}.")
            object.__setattr__(self, "background", background)

    def replace(self, **changes: Any) -> "Effects":
        """A copy with `changes`."""
        return dataclasses.replace(self, **changes)

    def resolve(self, *, captured: object, distortion: object, exposures: object) -> "Effects":
        """These effects with every flag decided, given the arrays of a render (None: not given).

        Raises:
            InputError: a flag is True without its array, or False with it.
        """
        arrays = {"captured": captured, "distortion": distortion, "exposures": exposures}
        is_given = {field: arrays[name] is not None for field, name in NEEDED_ARRAYS.items()}
        for field, name in NEEDED_ARRAYS.items():
            flag = getattr(self, field)
            if flag and not is_given[field]:
                raise InputError(
                    f"render: effects.{field} is on and wants {name}, got none; pass it or unset the flag."
                )
            if flag is False and is_given[field]:
                raise InputError(
                    f"render: effects.{field} is off and wants no {name}, got one; leave it out or unset the flag."
                )
        return self.replace(**is_given)

    @property
    def needs_alpha(self) -> bool:
        """True if alpha is composited: asked for, or needed by depth or background."""
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
    """The fewest effects that show a scene correctly. It looks at values: call it outside jit.

    Args:
        gaussians: the scene.
        camera: the cameras to render from.
        captured: the cameras that the scene was made from. The 3D filter is on if a camera samples the scene over 1.05
            times as finely as they do.
        distortion: OPENCV coefficients; distortion is on if one is not 0.
        exposures: affine color corrections; exposure is on if those of several frames differ (a common one is in the
            scene's colors already), or a single one is not the identity.
        outputs: passed on.

    Returns:
        The effects, SH degree included. A flag is False where its array is given but not needed: do not pass that
        array to `render`.
    """
    return Effects(
        sh_degree=_used_degree(np.asarray(gaussians.sh, np.float32)),
        filter_3d=None if captured is None else _sampling_ratio(gaussians, camera, captured) > FINER_SAMPLING,
        distortion=None if distortion is None else bool(np.any(np.asarray(distortion) != 0)),
        exposure=None if exposures is None else _differ(np.asarray(exposures)),
        outputs=outputs,
    )


def _used_degree(sh: np.ndarray) -> int:
    """Highest SH band with an entry other than 0."""
    used = np.flatnonzero(np.any(sh != 0, axis=(0, 2)))
    return int(np.sqrt(used[-1])) if used.size else 0


def _differ(exposures: np.ndarray) -> bool:
    """True if frames differ in exposure; a single one is compared with no correction."""
    flat = exposures.reshape(-1, 12)
    usual = flat[:1] if len(flat) > 1 else np.eye(3, 4).reshape(1, 12)
    return bool(np.any(np.abs(flat - usual) > 1e-6))


def _sampling_ratio(gaussians: Gaussians, camera: Camera, captured: Camera) -> float:
    """Ratio of the sampling rate (f / z) of present Gaussians to that of the captured cameras: 99 % quantile."""
    present = np.asarray(gaussians.opacities) > 0
    means = np.asarray(gaussians.means, np.float64)[present]
    ours, theirs = _sampling_rates(means, camera), _sampling_rates(means, captured)
    seen = (ours > 0) & (theirs > 0)
    return float(np.quantile(ours[seen] / theirs[seen], 0.99)) if seen.any() else 0.0


def _sampling_rates(means: np.ndarray, camera: Camera) -> np.ndarray:
    """Pixels per scene unit at each mean in the camera that samples it most finely; 0 where none sees it."""
    rates = np.zeros(means.shape[0])
    viewmats = np.asarray(camera.viewmats, np.float64).reshape(-1, 4, 4)
    for viewmat, K in zip(viewmats, np.asarray(camera.Ks, np.float64).reshape(-1, 3, 3), strict=True):
        x, y, z = (means @ viewmat[:3, :3].T + viewmat[:3, 3]).T
        z = np.where(z > constants.NEAR, z, np.inf)
        u, v = K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]
        inside = (u >= 0) & (u <= camera.width) & (v >= 0) & (v <= camera.height)
        rates = np.maximum(rates, np.where(inside, np.abs(K[0, 0]) / z, 0.0))
    return rates
