"""EWA projection of 3D Gaussians to the screen, with the camera's full pinhole model.

Everything is elementwise over `[b n]` (cameras x Gaussians): no matmul unit, no vmap, any float dtype. Screen covariances
are built from their 2x3 square root M (cov = M M^T), so they are positive semi-definite and their determinant,
|row_0 x row_1|^2, does not cancel.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ssplat_jax.gaussians import Gaussians
from ssplat_jax.geometry.cameras import Camera
from ssplat_jax.geometry.rotations import quats_to_matrices
from ssplat_jax.render import constants
from ssplat_jax.render.effects import Effects
from ssplat_jax.struct import pytree, replace


@pytree
class Splats:
    """Gaussians on the screens of `b` cameras. Invisible ones have opacity 0 and harmless values elsewhere."""

    means2d: Float[Array, "b n 2"]  # pixels
    conics: Float[Array, "b n 3"]  # inverse screen covariance (xx, xy, yy), 1/px^2
    opacities: Float[Array, "b n"]  # after the filter's compensation
    depths: Float[Array, "b n"]  # camera z
    extents: Float[Array, "b n 2"]  # half size of the box outside of which alpha < 1/255, pixels
    visible: Bool[Array, "b n"]


def finite_rows(gaussians: Gaussians) -> Bool[Array, " n"]:
    """Rows whose every entry is finite and at most `constants.LARGEST` in magnitude."""
    rows = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities[:, None], gaussians.sh)
    small = [jnp.abs(x) <= constants.LARGEST for x in rows]  # False for NaN too
    return jnp.stack([jnp.all(s.reshape(s.shape[0], -1), axis=1) for s in small]).all(axis=0)


def cull_non_finite(gaussians: Gaussians) -> tuple[Gaussians, Int[Array, ""]]:
    """`gaussians` with unusable rows made absent, and how many of those were present (opacity not 0).

    Limits:
        NaN and infinite rows become harmless ones before any arithmetic: their gradient is 0, never NaN.
    """
    keep = finite_rows(gaussians)
    num_culled = jnp.sum(~keep & (gaussians.opacities != 0), dtype=jnp.int32)
    column = keep[:, None]
    safe = replace(
        gaussians,
        means=jnp.where(column, gaussians.means, 0.0),
        quats=jnp.where(column, gaussians.quats, 1.0),
        scales=jnp.where(column, gaussians.scales, 1.0),
        opacities=jnp.where(keep, gaussians.opacities, 0.0),
        sh=jnp.where(column[..., None], gaussians.sh, 0.0),
    )
    return safe, num_culled


def camera_points(means: Float[Array, "n 3"], viewmats: Float[Array, "b 4 4"]) -> tuple[Float[Array, "b n"], ...]:
    """The three camera coordinates of world points."""
    return tuple(
        sum(viewmats[:, i, j, None] * means[:, j] for j in range(3)) + viewmats[:, i, 3, None] for i in range(3)
    )


def project(gaussians: Gaussians, camera: Camera, effects: Effects) -> Splats:
    """The screen-space Gaussians that `camera` (one batch axis) sees of finite `gaussians`.

    Skew, `Ks[0, 1]`, is not modelled.

    Limits:
        z <= 0.01: invisible, zero gradient.
        Outside the image by more than 0.3 half widths (tangent): the Jacobian is that of the clamped direction.
        Scales below about 1e-6 px under the Mip filter are invisible (compensation 0), with a zero gradient.
        Scales up to 1e12 / focal are finite; quaternions of any length, zero counts as the identity.
    """
    x, y, z = camera_points(gaussians.means, camera.viewmats)
    in_front = z > constants.NEAR
    z = jnp.where(in_front, z, 1.0)
    fx, fy, cx, cy = (camera.Ks[:, i, j, None] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    means2d = jnp.stack([fx * x / z + cx, fy * y / z + cy], axis=-1)
    roots = _screen_roots(gaussians, camera, (x, y, z))
    conics, variances, compensation = _filtered(*roots, effects)
    opacities = jnp.broadcast_to(gaussians.opacities, z.shape)
    if compensation is not None:
        opacities = opacities * compensation
    visible = in_front & (opacities >= constants.ALPHA_MIN) & jnp.all(jnp.isfinite(means2d), axis=-1)
    visible &= jnp.all(jnp.isfinite(conics), axis=-1)
    opacities = jnp.where(visible, opacities, 0.0)
    # alpha >= 1/255 exactly where the Mahalanobis distance is at most `reach`; the inflation covers its rounding.
    reach = jnp.sqrt(2.0 * jnp.log(jnp.maximum(jax.lax.stop_gradient(opacities) / constants.ALPHA_MIN, 1.0)))
    extents = 1.0001 * reach[..., None] * jnp.sqrt(jax.lax.stop_gradient(variances)) + 1e-3
    return Splats(
        means2d=jnp.where(visible[..., None], means2d, 0.0),
        conics=jnp.where(visible[..., None], conics, 0.0),
        opacities=opacities,
        depths=z,
        extents=jnp.where(visible[..., None], extents, 0.0),
        visible=visible,
    )


def _screen_roots(gaussians: Gaussians, camera: Camera, points: tuple[Float[Array, "b n"], ...]):
    """Rows of M = J W R S, a square root of the screen covariance; each a triple of `[b n]` arrays."""
    x, y, z = points
    fx, fy, cx, cy = (camera.Ks[:, i, j, None] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    margin_x = constants.FRUSTUM_MARGIN * 0.5 * camera.width / fx
    margin_y = constants.FRUSTUM_MARGIN * 0.5 * camera.height / fy
    tan_x = jnp.clip(x / z, -cx / fx - margin_x, (camera.width - cx) / fx + margin_x)
    tan_y = jnp.clip(y / z, -cy / fy - margin_y, (camera.height - cy) / fy + margin_y)
    world = camera.viewmats[:, :3, :3, None]  # b 3 3 1
    # Rows of J W: what a world displacement does to the pixel.
    to_u = [(fx / z) * (world[:, 0, j] - tan_x * world[:, 2, j]) for j in range(3)]
    to_v = [(fy / z) * (world[:, 1, j] - tan_y * world[:, 2, j]) for j in range(3)]
    axes = quats_to_matrices(gaussians.quats) * gaussians.scales[:, None, :]  # n 3 3, columns are the scaled axes
    root_u = [sum(to_u[j] * axes[:, j, k] for j in range(3)) for k in range(3)]
    root_v = [sum(to_v[j] * axes[:, j, k] for j in range(3)) for k in range(3)]
    return root_u, root_v


def _filtered(root_u, root_v, effects: Effects):
    """Conic, variances and opacity compensation of the screen covariance, filtered as `effects` say."""
    kernels = {"mip": constants.MIP_KERNEL, "classic": constants.CLASSIC_DILATION, "none": constants.UNFILTERED_FLOOR}
    kernel = kernels[effects.antialias]
    # In units of the largest entry nothing overflows, whatever the scale; a constant to the gradient.
    largest = sum(jnp.abs(jax.lax.stop_gradient(m)) for m in (*root_u, *root_v))
    unit = jnp.maximum(largest, 1.0)
    u, v = [m / unit for m in root_u], [m / unit for m in root_v]
    kernel = kernel / unit / unit
    uu, uv, vv = (sum(a * b for a, b in zip(p, q, strict=True)) for p, q in ((u, u), (u, v), (v, v)))
    cross = (u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0])
    det = sum(c * c for c in cross)
    det_filtered = det + kernel * (uu + vv + kernel)
    conics = jnp.stack([vv + kernel, -uv, uu + kernel], axis=-1) / det_filtered[..., None] / (unit * unit)[..., None]
    variances = jnp.stack([uu + kernel, vv + kernel], axis=-1) * (unit * unit)[..., None]
    if effects.antialias != "mip":
        return conics, variances, None
    ratio = det / det_filtered
    keep = ratio > constants.COMPENSATION_CUT
    return conics, variances, jnp.where(keep, jnp.sqrt(jnp.where(keep, ratio, 1.0)), 0.0)
