"""Rotations: quaternions (wxyz), matrices, and what they do to spherical harmonics.

Leading axes broadcast. There is no vmap here: jax 0.10.2 miscompiles vmapped 3-vector arithmetic on the CPU.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64

from ssplat_jax.core.gaussians import SH_C0
from ssplat_jax.core.numerics import columns, safe_normalize

AnyArray = Array | np.ndarray


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
    w = jnp.stack([1 + m00 + m11 + m22, a, b, c], axis=-1)
    x = jnp.stack([a, 1 + m00 - m11 - m22, d, e], axis=-1)
    y = jnp.stack([b, d, 1 - m00 + m11 - m22, f], axis=-1)
    z = jnp.stack([c, e, f, 1 - m00 - m11 + m22], axis=-1)
    rows = jnp.stack([w, x, y, z], axis=-2)
    best = jnp.argmax(jnp.diagonal(rows, axis1=-2, axis2=-1), axis=-1)
    quats = safe_normalize(jnp.take_along_axis(rows, best[..., None, None], axis=-2)[..., 0, :])
    return jnp.where(quats[..., :1] < 0, -quats, quats)


def multiply_quats(a: Float[Array, "*s 4"], b: Float[Array, "*s 4"]) -> Float[Array, "*s 4"]:
    """Hamilton product: the rotation `b` followed by the rotation `a`."""
    aw, ax, ay, az = jnp.moveaxis(a, -1, 0)
    bw, bx, by, bz = jnp.moveaxis(b, -1, 0)
    w = aw * bw - ax * bx - ay * by - az * bz
    x = aw * bx + ax * bw + ay * bz - az * by
    y = aw * by - ax * bz + ay * bw + az * bx
    z = aw * bz + ax * by - ay * bx + az * bw
    return jnp.stack([w, x, y, z], axis=-1)


_C1 = 0.4886025119029199
_C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
_C3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)


def sh_basis(directions: Float[AnyArray, "*s 3"], degree: int) -> Float[AnyArray, "*s k"]:
    """The (degree + 1)^2 real spherical harmonics at unit `directions`, in the order and with the signs of splat files.

    Limits:
        Polynomials of the components: finite and smooth everywhere, the poles included.
    """
    x, y, z = (directions[..., i] for i in range(3))
    xp = np if isinstance(directions, np.ndarray) else jnp
    terms = [xp.full_like(x, SH_C0)]
    if degree >= 1:
        terms += [-_C1 * y, _C1 * z, -_C1 * x]
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        terms += [_C2[0] * x * y, -_C2[0] * y * z, _C2[1] * (2 * zz - xx - yy), -_C2[0] * x * z, _C2[2] * (xx - yy)]
        if degree >= 3:
            terms += [
                -_C3[0] * y * (3 * xx - yy),
                _C3[1] * x * y * z,
                -_C3[2] * y * (4 * zz - xx - yy),
                _C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
                -_C3[2] * x * (4 * zz - xx - yy),
                _C3[4] * z * (xx - yy),
                -_C3[0] * x * (xx - 3 * yy),
            ]
    return xp.stack(terms, axis=-1)


def sh_rotation(rotation: Float64[np.ndarray, "3 3"], degree: int) -> Float64[np.ndarray, "k k"]:
    """Matrix that maps SH coefficients of a scene to those of the scene rotated by `rotation`; `degree` is 0 to 3.

    Each band is solved from its values in fixed directions: Y(d) c' = Y(R^T d) c for every d. The result is exact to
    float64 rounding, since a band is closed under rotation and the directions over-determine it.
    """
    directions = np.random.default_rng(0).normal(size=(32, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    mixing = np.zeros(((degree + 1) ** 2, (degree + 1) ** 2))
    original, rotated = sh_basis(directions, degree), sh_basis(directions @ rotation, degree)
    for band in range(degree + 1):
        rows = slice(band**2, (band + 1) ** 2)
        mixing[rows, rows] = np.linalg.lstsq(original[:, rows], rotated[:, rows], rcond=None)[0]
    return mixing
