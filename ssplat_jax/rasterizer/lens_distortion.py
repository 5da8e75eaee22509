"""OPENCV radial-tangential lens distortion of normalized image coordinates: k1, k2, p1, p2, k3."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

TANGENTS = np.tan(np.radians(np.linspace(0.0, 89.4, 2048)))
"""Radii at which the polynomial is examined: from the axis to an angle that no such lens sees."""


def distort(
    x: Float[Array, "b n"], y: Float[Array, "b n"], coefficients: Float[Array, "b 5"]
) -> tuple[tuple[Float[Array, "b n"], ...], tuple[Float[Array, "b n"], ...]]:
    """Distorted (x, y), and their derivatives (dx/dx, dx/dy, dy/dx, dy/dy) by the undistorted coordinates."""
    k1, k2, p1, p2, k3 = (coefficients[:, i, None] for i in range(5))
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + 3 * r2 * k3))  # d radial / dx = slope x
    distorted_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    distorted_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    cross = slope * x * y + 2 * p1 * x + 2 * p2 * y
    along_x = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
    along_y = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
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
