"""`Gaussians`: a scene of 3D Gaussians as one pytree of activated values."""

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from ssplat_jax.core.errors import InputError, refusal
from ssplat_jax.core.pytree import pytree, replace, static

SH_C0 = 0.28209479177387814  # Y_0^0, the constant band: color = 0.5 + SH_C0 * dc


@pytree
class Gaussians:
    """`n` 3D Gaussians in the world frame of the cameras.

    A row with opacity 0 is absent: fixed-capacity producers (the cache) pad with such rows.
    """

    means: Float[Array, "n 3"]  # scene units
    quats: Float[Array, "n 4"]  # wxyz, any length
    scales: Float[Array, "n 3"]  # standard deviations along the axes, scene units
    opacities: Float[Array, " n"]  # [0, 1]
    sh: Float[Array, "n k 3"]  # real SH, (degree + 1)^2 terms; color = clip(0.5 + sum, 0, inf)
    render_mode: str = static(default="mip")
    """The renderer that the scene is made for: `mip`, 3DGS with the 2D Mip filter (ours); `default`, 3DGS; `2dgs`."""
    offset: tuple[float, float, float] = static(default=(0.0, 0.0, 0.0))
    """Origin of `means` in the frame of the scene: float32 cannot hold places far from zero."""

    @staticmethod
    def from_rgb(
        *,
        means: Float[Array, "n 3"],
        quats: Float[Array, "n 4"],
        scales: Float[Array, "n 3"],
        opacities: Float[Array, " n"],
        colors: Float[Array, "n 3"],
    ) -> "Gaussians":
        """Gaussians whose color does not depend on the view; `colors` in [0, 1], the rest as in the class."""
        is_known = not isinstance(colors, Tracer)
        if not jnp.issubdtype(colors.dtype, jnp.floating) or (is_known and np.mean(np.asarray(colors) > 4.0) > 0.5):
            fix = "divide bytes by 255"
            raise refusal("from_rgb: colors", wanted="floats in [0, 1]", got=f"{colors.dtype} of 0 to 255", fix=fix)
        return Gaussians(means, quats, scales, opacities, sh=((colors - 0.5) / SH_C0)[:, None, :])

    def __repr__(self) -> str:
        """The number of rows and the SH degree; arrays of a scene are too long to print."""
        if not hasattr(self.means, "shape") or not hasattr(self.sh, "shape"):
            return f"Gaussians(means={self.means!r}, sh={self.sh!r})"  # rebuilt by a transform
        return f"Gaussians({self.num_gaussians:,}, SH {self.sh_degree})"

    @property
    def num_gaussians(self) -> int:
        """Rows, absent ones included."""
        return self.means.shape[0]

    @property
    def sh_degree(self) -> int:
        """Highest SH band."""
        return round(self.sh.shape[-2] ** 0.5) - 1


def check_gaussians(gaussians: Gaussians, where: str) -> None:
    """Checks the shapes of a scene, of tracers too. Not done on construction: inside transforms, fields may hold
    batches. Outside of transforms, raw values of files, which are logits and logarithms, are told from activated ones.

    Raises:
        InputError: naming the field of a wrong shape or of raw values, after `where`.
    """
    n = gaussians.means.shape[0] if getattr(gaussians.means, "ndim", 0) else "n"
    wanted = {"means": (n, 3), "quats": (n, 4), "scales": (n, 3), "opacities": (n,), "sh": (n, "k", 3)}
    for name, shape in wanted.items():
        got = getattr(getattr(gaussians, name), "shape", None)
        if got is None:
            raise InputError(f"{where}: {name} must be an array, got {type(getattr(gaussians, name)).__name__}.")
        if len(got) != len(shape) or any(isinstance(s, int) and s != g for s, g in zip(shape, got, strict=True)):
            sizes = " ".join(map(str, shape))
            raise InputError(f"{where}: {name} of the Gaussians must be [{sizes}], got {list(got)}.")
    for name, most, fix in (("opacities", 1.0, "jax.nn.sigmoid"), ("scales", np.inf, "jnp.exp")):
        values = getattr(gaussians, name)
        if isinstance(values, Tracer):
            continue
        values = np.asarray(values)
        if values.size and np.mean((values < 0) | (values > most)) > 0.5:
            fix = f"take {fix} of them"
            raise refusal(f"{where}: {name}", wanted="activated values", got="raw ones, as in files", fix=fix)


def mean_color(gaussians: Gaussians) -> Float[Array, "3"]:
    """Mean constant color of the Gaussians, weighted by opacity; black for an empty scene.

    It serves as the background of `fill_holes`.

    Limits:
        Rows whose color or opacity is not finite are left out.
    """
    is_finite = jnp.isfinite(gaussians.sh[:, 0]).all(axis=-1) & jnp.isfinite(gaussians.opacities)
    weights = jnp.where(is_finite, gaussians.opacities, 0.0)
    colors = jnp.maximum(0.5 + SH_C0 * jnp.where(is_finite[:, None], gaussians.sh[:, 0], 0.0), 0.0)
    total = jnp.sum(weights)
    return jnp.sum(weights[:, None] * colors, axis=0) / jnp.where(total > 0, total, 1.0)


def scale_colors(gaussians: Gaussians, factors: Float[Array, "3"]) -> Gaussians:
    """Gaussians whose color, seen from anywhere, is multiplied by a positive factor per channel: another exposure."""
    # factor * (0.5 + C0 dc) = 0.5 + C0 dc', written so that a factor of 1 changes no bit.
    constant = gaussians.sh[:, :1] * factors + (factors - 1.0) * (0.5 / SH_C0)
    return replace(gaussians, sh=jnp.concatenate([constant, gaussians.sh[:, 1:] * factors], axis=1))


def with_sh_degree(gaussians: Gaussians, degree: int) -> Gaussians:
    """`gaussians` with SH bands up to `degree`, the new ones zero: every image stays. Higher bands are kept."""
    missing = max((degree + 1) ** 2 - gaussians.sh.shape[1], 0)
    return replace(gaussians, sh=jnp.pad(gaussians.sh, ((0, 0), (0, missing), (0, 0)))) if missing else gaussians


def mask_gaussians(gaussians: Gaussians, keep) -> Gaussians:
    """`gaussians` with the rows outside `keep` made absent: opacity 0, harmless shape, same size."""
    identity = jnp.array([1.0, 0.0, 0.0, 0.0], gaussians.quats.dtype)
    return replace(
        gaussians,
        means=jnp.where(keep[:, None], gaussians.means, 0.0),
        quats=jnp.where(keep[:, None], gaussians.quats, identity),
        scales=jnp.where(keep[:, None], gaussians.scales, 1e-6),
        opacities=jnp.where(keep, gaussians.opacities, 0.0),
        sh=jnp.where(keep[:, None, None], gaussians.sh, 0.0),
    )
