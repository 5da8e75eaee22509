"""Colors from real spherical harmonics of degree 0 to 3, as splat files store them (Condon-Shortley, m = -l..l)."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ssplat_jax.core.gaussians import SH_C0

_C1 = 0.4886025119029199
_C2 = (1.0925484305920792, 1.0925484305920792, 0.31539156525252005, 1.0925484305920792, 0.5462742152960396)
_C3 = (
    0.5900435899266435,
    2.890611442640554,
    0.4570457994644658,
    0.3731763325901154,
    0.4570457994644658,
    1.445305721320277,
    0.5900435899266435,
)


def sh_basis(directions: Float[Array, "*s 3"], degree: int) -> Float[Array, "*s k"]:
    """The (degree + 1)^2 basis functions at unit `directions`.

    Limits:
        Polynomials of the components: finite and smooth everywhere, the poles included.
    """
    x, y, z = (directions[..., i] for i in range(3))
    terms = [jnp.full_like(x, SH_C0)]
    if degree >= 1:
        terms += [-_C1 * y, _C1 * z, -_C1 * x]
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        terms += [
            _C2[0] * x * y,
            -_C2[1] * y * z,
            _C2[2] * (2 * zz - xx - yy),
            -_C2[3] * x * z,
            _C2[4] * (xx - yy),
        ]
        if degree >= 3:
            terms += [
                -_C3[0] * y * (3 * xx - yy),
                _C3[1] * x * y * z,
                -_C3[2] * y * (4 * zz - xx - yy),
                _C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
                -_C3[4] * x * (4 * zz - xx - yy),
                _C3[5] * z * (xx - yy),
                -_C3[6] * x * (xx - 3 * yy),
            ]
    return jnp.stack(terms, axis=-1)


def sh_colors(
    sh: Float[Array, "n k 3"], directions: Float[Array, "*b n 3"] | None, degree: int
) -> Float[Array, "*b n 3"]:
    """Colors max(0.5 + sum, 0) along unit `directions` (camera to Gaussian), from the bands up to `degree`.

    At degree 0, `directions` is not used and may be None; the colors are then `[n 3]`.

    Limits:
        0.5 + sum < 0 gives 0, with a zero gradient; at exactly 0 the gradient is halved.
    """
    if degree == 0 or directions is None:
        return jnp.maximum(0.5 + SH_C0 * sh[:, 0, :], 0.0)
    basis = sh_basis(directions, degree)
    # A sum of products: a dot product would have the platform's matmul precision.
    return jnp.maximum(0.5 + jnp.sum(basis[..., None] * sh[:, : basis.shape[-1], :], axis=-2), 0.0)
