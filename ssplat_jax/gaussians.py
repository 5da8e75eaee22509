"""The scene: 3D Gaussians as one pytree of activated values."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ssplat_jax.pytree import pytree, replace

SH_C0 = 0.28209479177387814  # Y_0^0, the constant band: color = 0.5 + SH_C0 * dc


@pytree
class Gaussians:
    """`n` 3D Gaussians in the world frame of the cameras that look at them.

    A row with opacity 0 is absent: fixed-capacity producers (the cache) pad with such rows.
    """

    means: Float[Array, "n 3"]  # scene units
    quats: Float[Array, "n 4"]  # wxyz, any length
    scales: Float[Array, "n 3"]  # standard deviations along the axes, scene units
    opacities: Float[Array, " n"]  # [0, 1]
    sh: Float[Array, "n k 3"]  # real SH, (degree + 1)^2 terms; color = clip(0.5 + sum, 0, inf)

    @staticmethod
    def from_rgb(
        *,
        means: Float[Array, "n 3"],
        quats: Float[Array, "n 4"],
        scales: Float[Array, "n 3"],
        opacities: Float[Array, " n"],
        colors: Float[Array, "n 3"],
    ) -> "Gaussians":
        """Gaussians of one color from every side; `colors` in [0, 1]."""
        return Gaussians(
            means=means, quats=quats, scales=scales, opacities=opacities, sh=((colors - 0.5) / SH_C0)[:, None, :]
        )

    @property
    def num_gaussians(self) -> int:
        """Rows, absent ones included."""
        return self.means.shape[0]

    @property
    def sh_degree(self) -> int:
        """Highest SH band held."""
        return round(self.sh.shape[-2] ** 0.5) - 1


def concatenate(parts: list[Gaussians]) -> Gaussians:
    """All rows of `parts` (equal SH degree), in order."""
    return Gaussians(
        *(
            jnp.concatenate([getattr(p, name) for p in parts], axis=0)
            for name in ("means", "quats", "scales", "opacities", "sh")
        )
    )


def mean_color(gaussians: Gaussians) -> Float[Array, "3"]:
    """Mean color of the Gaussians, SH bands above the constant left out, weighted by opacity; black of none.

    What to show where a reconstruction has holes, when nothing better is known.
    """
    colors = jnp.maximum(0.5 + SH_C0 * gaussians.sh[:, 0], 0.0)
    total = jnp.sum(gaussians.opacities)
    return jnp.sum(gaussians.opacities[:, None] * colors, axis=0) / jnp.where(total > 0, total, 1.0)


def mask_gaussians(gaussians: Gaussians, keep) -> Gaussians:
    """Makes the rows outside `keep` absent (opacity 0, harmless shape), at the same size."""
    identity = jnp.array([1.0, 0.0, 0.0, 0.0], gaussians.quats.dtype)
    return replace(
        gaussians,
        means=jnp.where(keep[:, None], gaussians.means, 0.0),
        quats=jnp.where(keep[:, None], gaussians.quats, identity),
        scales=jnp.where(keep[:, None], gaussians.scales, 1e-6),
        opacities=jnp.where(keep, gaussians.opacities, 0.0),
        sh=jnp.where(keep[:, None, None], gaussians.sh, 0.0),
    )
