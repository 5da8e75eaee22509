"""Rotation of spherical harmonics coefficients.

Colors of degree 1 to 3 depend on direction, so a rotated scene needs new coefficients. Order and signs are those of
splat files: (1), (-y, z, -x), (xy, -yz, 2zz-xx-yy, -xz, xx-yy), ...
"""

import numpy as np
from jaxtyping import Float64

# Relative norms within a band, integrated over the sphere; a factor common to a band cancels.
SQRT3, SQRT6, SQRT10, SQRT15 = np.sqrt([3.0, 6.0, 10.0, 15.0])


def _bands(directions: Float64[np.ndarray, "n 3"]) -> list[Float64[np.ndarray, "n _"]]:
    """Real spherical harmonics of bands 0 to 3, each band up to a common factor."""
    x, y, z = directions.T
    xx, yy, zz = x * x, y * y, z * z
    bands = [
        [np.ones_like(x)],
        [-y, z, -x],
        [2 * SQRT3 * x * y, -2 * SQRT3 * y * z, 2 * zz - xx - yy, -2 * SQRT3 * x * z, SQRT3 * (xx - yy)],
        [
            -SQRT10 * y * (3 * xx - yy),
            4 * SQRT15 * x * y * z,
            -SQRT6 * y * (4 * zz - xx - yy),
            2 * z * (2 * zz - 3 * xx - 3 * yy),
            -SQRT6 * x * (4 * zz - xx - yy),
            2 * SQRT15 * z * (xx - yy),
            -SQRT10 * x * (xx - 3 * yy),
        ],
    ]
    return [np.stack(band, axis=-1) for band in bands]


def sh_rotation(rotation: Float64[np.ndarray, "3 3"], degree: int) -> Float64[np.ndarray, "k k"]:
    """Matrix that maps SH coefficients of a scene to those of the scene rotated by `rotation`; `degree` is 0 to 3.

    Each band is solved from its values in fixed directions: Y(d) c' = Y(R^T d) c for every d. The result is exact to
    float64 rounding, since a band is closed under rotation and the directions over-determine it.
    """
    directions = np.random.default_rng(0).normal(size=(32, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    mixing = np.zeros(((degree + 1) ** 2, (degree + 1) ** 2))
    original, rotated = _bands(directions), _bands(directions @ rotation)
    for band in range(degree + 1):
        rows = slice(band**2, (band + 1) ** 2)
        mixing[rows, rows] = np.linalg.lstsq(original[band], rotated[band], rcond=None)[0]
    return mixing
