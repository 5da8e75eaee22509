"""The effects of a render. All are static: an effect that is off adds no operation to the compiled program."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ssplat_jax.core.cameras import Camera, check_camera
from ssplat_jax.core.errors import InputError, refusal
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.core.numerics import columns, with_rank_promotion
from ssplat_jax.core.pytree import replace
from ssplat_jax.rasterizer import constants

OUTPUTS = ("color", "alpha", "depth", "median_depth")

NEEDED_ARRAYS = {"filter_3d": "captured", "distortion": "distortion", "exposure": "exposures"}
"""The fields of `Effects` that need an array, and the argument of `render` that holds it."""

FILTERS = {"mip": "mip", "default": "classic"}  # the filter of each renderer that a scene may be made for


@dataclasses.dataclass(frozen=True)
class Effects:
    """The effects of a render. Hashable; changing one recompiles.

    An effect that needs an array is on if `render` is given that array. True asks for the array, without which `render`
    refuses; False leaves the array out.
    """

    sh_degree: int | None = None
    """Highest SH band to evaluate; None takes all that the Gaussians hold."""
    antialias: str | None = None
    """`mip`: 2D Mip filter (0.1 px^2, opacity compensated); `classic`: 0.3 px^2 dilation, as 3DGS has it; `none`: point
    sampling. None takes the filter that the scene is made for (`Gaussians.render_mode`)."""
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
        if self.antialias not in (None, "mip", "classic", "none"):
            raise InputError(f"effects: antialias must be None, 'mip', 'classic' or 'none', got {self.antialias!r}.")
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

    def resolve(self, render_mode: str, **arrays: object) -> "Effects":
        """These effects with every field decided, given a scene's render mode and the arrays of a render (or None).

        Raises:
            InputError: a flag is True without its array, or the scene is made for a renderer unlike ours.
        """
        if self.antialias is None and render_mode not in FILTERS:
            fix = "draw it as 3D Gaussians with Effects(antialias='classic'), or where it was made"
            raise refusal("render", wanted="a scene of 3D Gaussians", got=f"one made for {render_mode}", fix=fix)
        flags: dict[str, Any] = {"antialias": self.antialias or FILTERS[render_mode]}
        for field, name in NEEDED_ARRAYS.items():
            flag, is_given = getattr(self, field), arrays[name] is not None
            if flag and not is_given:
                raise InputError(f"render: effects.{field} is on and wants {name}, got none; pass it or unset it.")
            flags[field] = is_given and flag is not False
        return self.replace(**flags)

    @property
    def needs_alpha(self) -> bool:
        """True if alpha is composited: asked for, or needed by depth or background."""
        return bool({"alpha", "depth"} & set(self.outputs)) or self.background is not None


def camera_points(means: Float[Array, "n 3"], viewmats: Float[Array, "b 4 4"]) -> tuple[Float[Array, "b n"], ...]:
    """Camera coordinates x, y and z of world points."""
    point = columns(means)
    return tuple(sum(viewmats[:, i, j, None] * point[j] for j in range(3)) + viewmats[:, i, 3, None] for i in range(3))


def near_planes(gaussians: Gaussians, viewmats: Float[Array, "b 4 4"]) -> Float[Array, " b"]:
    """The camera z up to which Gaussians are culled: `constants.NEAR`, limited by `constants.NEAR_SHARES`.

    The typical depth is the geometric mean over the present Gaussians before the camera. Constants to the gradient.
    """
    means, opacities, viewmats = jax.lax.stop_gradient((gaussians.means, gaussians.opacities, viewmats))
    depths = camera_points(means, viewmats)[2]
    counts = (depths > 0) & (depths <= constants.MAX_MAGNITUDE) & (opacities > 0)
    logs = jnp.where(counts, jnp.log(jnp.where(counts, depths, 1.0)), 0.0)
    total = jnp.sum(counts, axis=1, dtype=depths.dtype)
    typical = jnp.exp(jnp.sum(logs, axis=1) / jnp.maximum(total, 1.0))
    least, most = (share * typical for share in constants.NEAR_SHARES)
    return jnp.where(total > 0, jnp.clip(jnp.full_like(typical, constants.NEAR), least, most), constants.NEAR)


def sampling_rates(gaussians: Gaussians, captured: Camera) -> Float[Array, " n"]:
    """Pixels per scene unit, f / z, in the captured camera that samples each mean most finely; 0 where none sees it.

    A camera sees means before its near plane and inside its image, enlarged by 15 % on each side.
    """
    means = gaussians.means

    def see(rates, one):
        viewmat, K, near = one
        x, y, z = (entry[0] for entry in camera_points(means, viewmat[None]))
        in_front = z > near
        z = jnp.where(in_front, z, 1.0)
        u, v = K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]
        reach = 0.5 + constants.CAPTURE_MARGIN
        inside = (jnp.abs(u / captured.width - 0.5) <= reach) & (jnp.abs(v / captured.height - 0.5) <= reach)
        return jnp.maximum(rates, jnp.where(in_front & inside, jnp.abs(K[0, 0]) / z, 0.0)), None

    viewmats = captured.viewmats.reshape(-1, 4, 4).astype(means.dtype)
    cameras = (viewmats, captured.Ks.reshape(-1, 3, 3).astype(means.dtype), near_planes(gaussians, viewmats))
    return jax.lax.scan(see, jnp.zeros_like(means[:, 0]), cameras)[0]


@with_rank_promotion
def filter_3d(gaussians: Gaussians, captured: Camera) -> Gaussians:
    """`gaussians` convolved with a Gaussian of variance 0.2 squared sampling intervals, mass preserved.

    Gaussians that no captured camera sees get the widest filter of the others. The filter is a constant to the
    gradient; scales and opacities are differentiable through it.

    Limits:
        No camera sees anything: the Gaussians are returned unchanged.
        Scale 0: opacity 0 (a point has no mass), gradient finite.

    Raises:
        InputError: the camera is not usable, see `check_camera`.
    """
    check_camera(captured, "filter_3d", "captured camera")
    rates = jax.lax.stop_gradient(sampling_rates(gaussians, captured))
    lowest = jnp.min(jnp.where((rates > 0) & (gaussians.opacities > 0), rates, jnp.inf))
    rates = jnp.where(rates > 0, rates, lowest)
    variances = constants.FILTER_3D_VARIANCE / (rates * rates)  # 0 where no Gaussian is seen
    squares = gaussians.scales**2 + variances[:, None]
    scales = jnp.sqrt(jnp.maximum(squares, jnp.finfo(squares.dtype).tiny))
    kept = jnp.prod(jnp.minimum(jnp.abs(gaussians.scales) / scales, 1.0), axis=-1)
    return replace(gaussians, scales=scales, opacities=gaussians.opacities * kept)


TANGENTS = np.tan(np.radians(np.linspace(0.0, 89.4, 2048)))
"""Radii at which the polynomial is examined: from the axis to an angle that no such lens sees."""


def distort(
    x: Float[Array, "b n"], y: Float[Array, "b n"], coefficients: Float[Array, "b 5"]
) -> tuple[tuple[Float[Array, "b n"], ...], tuple[Float[Array, "b n"], ...]]:
    """Distorted (x, y), and their derivatives (dx/dx, dx/dy, dy/dx, dy/dy) by the undistorted coordinates."""
    k1, k2, p1, p2, k3 = (coefficients[:, i, None] for i in range(5))
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    rate = 2 * (k1 + r2 * (2 * k2 + 3 * r2 * k3))  # d radial / dx = rate x
    distorted_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    distorted_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    cross = rate * x * y + 2 * p1 * x + 2 * p2 * y
    along_x = radial + rate * x * x + 2 * p1 * y + 6 * p2 * x
    along_y = radial + rate * y * y + 6 * p1 * y + 2 * p2 * x
    return (distorted_x, distorted_y), (along_x, cross, cross, along_y)


def is_folded(derivatives: tuple[Float[Array, "b n"], ...]) -> Array:
    """True if the polynomial falls with the radius, outside the lens's field of view: such points are culled.

    It may rise again farther out. Points outside its first maximum, which `lens_field` finds, are culled too.
    """
    xx, xy, yx, yy = derivatives
    return ~((xx * yy - xy * yx > 0) & (jnp.minimum(xx, yy) > 0))


def lens_field(
    coefficients: Float[Array, "b 5"], corner: Float[Array, " b"]
) -> tuple[Float[Array, " b"], Float[Array, " b"]]:
    """The field of view of a lens by its radial terms, as undistorted radii (tangents of the angle to the axis).

    Returns:
        The radius of the polynomial's first maximum (at most that of 89.4 degrees), and the radius that is seen at the
        distorted radius `corner`, or the former where `corner` is not reached.
    """
    k1, k2, k3 = (coefficients[:, i, None] for i in (0, 1, 4))
    radii = jnp.asarray(TANGENTS, coefficients.dtype)
    squares = radii * radii
    rises = 1 + squares * (3 * k1 + squares * (5 * k2 + squares * 7 * k3)) > 0
    maximum = jnp.where(rises.all(axis=1), radii[-1], radii[jnp.argmin(rises, axis=1)])
    distorted = radii * (1 + squares * (k1 + squares * (k2 + squares * k3)))
    is_outside = (distorted >= corner[:, None]) | (radii >= maximum[:, None])
    return maximum, radii[jnp.argmax(is_outside, axis=1)]
