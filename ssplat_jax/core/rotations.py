"""Rotations: quaternions (wxyz), matrices, and what they do to spherical harmonics.

Leading axes broadcast. There is no vmap here: jax 0.10.2 miscompiles vmapped 3-vector arithmetic on the CPU.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64

from ssplat_jax.core.numerics import columns, safe_normalize

SQRT3, SQRT6, SQRT10, SQRT15 = np.sqrt([3.0, 6.0, 10.0, 15.0])
"""Relative norms of spherical harmonics within a band, integrated over the sphere."""


def quats_to_matrices(quats: Float[Array, "*s 4"]) -> Float[Array, "*s 3 3"]:
    """Rotation matrices of quaternions of any length.

    Limits:
        A quaternion of length 1e-12 or less gives the identity and a zero gradient.
    """
    return jnp.stack([jnp.stack(row, axis=-1) for row in matrix_entries(quats)], axis=-2)


def matrix_entries(quats: Float[Array, "*s 4"]) -> tuple[tuple[Float[Array, "*s"], ...], ...]:
    """The nine entries of `quats_to_matrices` as separate arrays, row by row.

    XLA fuses arithmetic on them, and their gradient needs no padding.
    """
    unit = safe_normalize(quats)
    is_zero = jnp.all(unit == 0, axis=-1, keepdims=True)
    w, x, y, z = columns(jnp.where(is_zero, jnp.array([1, 0, 0, 0], unit.dtype), unit))
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


def matrices_to_quats(matrices: Float[Array, "*s 3 3"]) -> Float[Array, "*s 4"]:
    """Unit quaternions with w >= 0 of rotation matrices.

    Four formulas give the same quaternion; the one with the largest divisor is used, so that none divides by 0.
    """
    m = matrices
    m00, m11, m22 = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    a, b, c = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    d, e, f = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    # Row i is 4 q_i q. Squares are on the diagonal, and the row with the largest one is well conditioned.
    rows = jnp.stack(
        [
            jnp.stack([1 + m00 + m11 + m22, a, b, c], axis=-1),
            jnp.stack([a, 1 + m00 - m11 - m22, d, e], axis=-1),
            jnp.stack([b, d, 1 - m00 + m11 - m22, f], axis=-1),
            jnp.stack([c, e, f, 1 - m00 - m11 + m22], axis=-1),
        ],
        axis=-2,
    )
    best = jnp.argmax(jnp.diagonal(rows, axis1=-2, axis2=-1), axis=-1)
    quats = safe_normalize(jnp.take_along_axis(rows, best[..., None, None], axis=-2)[..., 0, :])
    return jnp.where(quats[..., :1] < 0, -quats, quats)


def multiply_quats(a: Float[Array, "*s 4"], b: Float[Array, "*s 4"]) -> Float[Array, "*s 4"]:
    """Hamilton product: the rotation `b` followed by the rotation `a`."""
    aw, ax, ay, az = jnp.moveaxis(a, -1, 0)
    bw, bx, by, bz = jnp.moveaxis(b, -1, 0)
    return jnp.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def _bands(directions: Float64[np.ndarray, "n 3"]) -> list[Float64[np.ndarray, "n _"]]:
    """Real spherical harmonics of bands 0 to 3, each band up to a common factor.

    Order and signs are those of splat files: (1), (-y, z, -x), (xy, -yz, 2zz-xx-yy, -xz, xx-yy), ...
    """
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
