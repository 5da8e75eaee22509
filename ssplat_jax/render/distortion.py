"""OPENCV radial-tangential lens distortion of normalised image coordinates: k1, k2, p1, p2, k3."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def distort(
    x: Float[Array, "b n"], y: Float[Array, "b n"], coefficients: Float[Array, "b 5"]
) -> tuple[tuple[Float[Array, "b n"], ...], tuple[Float[Array, "b n"], ...]]:
    """Distorted (x, y), and their derivatives (dx/dx, dx/dy, dy/dx, dy/dy) by the undistorted ones."""
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
    """Where the polynomial has turned back on itself, outside of the lens's field of view: such points are culled."""
    xx, xy, yx, yy = derivatives
    return ~((xx * yy - xy * yx > 0) & (jnp.minimum(xx, yy) > 0))
