"""EWA projection of 3D Gaussians to the screen, with the camera's full pinhole model.

Everything is elementwise over `[b n]` (cameras x Gaussians): no matmul unit, no vmap, any float dtype. Screen
covariances are built from their 2x3 square root M (cov = M M^T), so they are positive semi-definite and their
determinant, |row_0 x row_1|^2, does not cancel. Conics are held as factors for the same reason: in the quadratic form
of a long thin Gaussian, the terms of dx^2, dx dy and dy^2 are large and nearly cancel (float32, 0.02 by 300 px at 44
degrees: alpha is wrong by 2e-2, as a sum of two squares by 1e-5).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.gaussians import Gaussians, mask_gaussians
from ssplat_jax.core.numerics import columns
from ssplat_jax.core.pytree import pytree, replace
from ssplat_jax.core.rotations import matrix_entries
from ssplat_jax.rasterizer import constants
from ssplat_jax.rasterizer.effects import Effects, camera_points, distort, is_folded, lens_field, near_planes

FILTER_VARIANCES = {
    "mip": constants.MIP_VARIANCE,
    "classic": constants.CLASSIC_VARIANCE,
    "none": constants.MIN_SCREEN_VARIANCE,
}
"""px^2 added to the screen covariance, by `Effects.antialias`; the projections take None as `mip`."""


@pytree
class Splats:
    """Gaussians projected to the images of `b` cameras. Invisible ones have opacity 0 and otherwise harmless values.

    `conic_factors` (p, q, r) are the triangular factor of half the conic, the inverse screen covariance: gsplat's
    `conics` are (2 p^2, 2 p q, 2 (q^2 + r^2)), and alpha = opacity exp(-(p dx + q dy)^2 - (r dy)^2).
    """

    means2d: Float[Array, "b n 2"]  # pixels
    conic_factors: Float[Array, "b n 3"]  # 1/px
    opacities: Float[Array, "b n"]  # after the filter's compensation
    depths: Float[Array, "b n"]  # camera z
    radii: Float[Array, "b n 2"]  # along x and y, pixels: half size of the box outside which alpha < 1/255
    visible: Bool[Array, "b n"]


def cull_non_finite(
    gaussians: Gaussians, features: Float[Array, "n c"] | None = None
) -> tuple[Gaussians, Int[Array, ""]]:
    """`gaussians` with non-finite rows made absent, and how many of them were present (opacity not 0).

    Entries above `constants.MAX_MAGNITUDE` are not finite. Rows with non-finite features are made absent too.

    Limits:
        NaN and infinite rows become harmless before any arithmetic: their gradient is 0, never NaN.
    """
    rows = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities[:, None], gaussians.sh)
    small = [jnp.abs(x) <= constants.MAX_MAGNITUDE for x in rows]  # False for NaN too
    keep = jnp.stack([jnp.all(s.reshape(s.shape[0], -1), axis=1) for s in small]).all(axis=0)
    if features is not None:
        keep &= jnp.all(jnp.isfinite(features), axis=-1)
    num_culled = jnp.sum(~keep & (gaussians.opacities != 0), dtype=jnp.int32)
    return mask_gaussians(gaussians, keep), num_culled


def cull_cameras(camera: Camera) -> tuple[Camera, Bool[Array, " b"]]:
    """`camera` with unusable poses and intrinsics replaced by identities, and which cameras are usable.

    Limits:
        NaN, infinite entries and a focal length of 0: the camera is unusable, it sees nothing and its gradients are 0.
    """
    usable = jnp.all(jnp.isfinite(camera.viewmats), axis=(1, 2)) & jnp.all(jnp.isfinite(camera.Ks), axis=(1, 2))
    usable &= (camera.Ks[:, 0, 0] != 0) & (camera.Ks[:, 1, 1] != 0)
    make_safe = lambda x: jnp.where(usable[:, None, None], x, jnp.eye(x.shape[-1], dtype=x.dtype))  # noqa: E731
    return replace(camera, viewmats=make_safe(camera.viewmats), Ks=make_safe(camera.Ks)), usable


def project(
    gaussians: Gaussians,
    camera: Camera,
    effects: Effects,
    distortion: Float[Array, "b 5"] | None = None,
    near: Float[Array, " b"] | None = None,
) -> Splats:
    """The projection of Gaussians to the screens of cameras.

    Args:
        gaussians: the scene, finite.
        camera: one batch axis; skew, `Ks[0, 1]`, is not modeled.
        effects: the filter, and whether `distortion` is used.
        distortion: OPENCV coefficients.
        near: camera z up to which Gaussians are culled; by default `near_planes`.

    Returns:
        Screen-space Gaussians.

    Limits:
        z <= near: invisible, zero gradient.
        Outside the image by more than 0.3 half widths (tangent): the Jacobian is that of the clamped direction.
        Scales below about 1e-6 px under the Mip filter: invisible (compensation 0), zero gradient.
        Standard deviation above 1e8 px on the screen, or mean more than 1e9 px off: invisible, zero gradient.
        Quaternions of any length; zero counts as the identity.
        Outside the first maximum of the distortion polynomial, or 89.4 degrees off axis: invisible, zero gradient.
    """
    x, y, z = camera_points(gaussians.means, camera.viewmats)
    near = near_planes(gaussians, camera.viewmats) if near is None else near
    in_front = z > near[:, None]
    z = jnp.where(in_front, z, 1.0)
    fx, fy, cx, cy = (camera.Ks[:, i, j, None] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    tan_x, tan_y = x / z, y / z
    if effects.distortion and distortion is not None:
        maximum, corner = lens_field(jax.lax.stop_gradient(distortion), _corner(jax.lax.stop_gradient(camera)))
        is_seen = tan_x * tan_x + tan_y * tan_y <= (maximum * maximum)[:, None]
        in_front &= is_seen & ~is_folded(distort(tan_x, tan_y, distortion)[1])
        tan_x, tan_y = (jnp.where(in_front, tan, 0.0) for tan in (tan_x, tan_y))
        means2d = distort(tan_x, tan_y, distortion)[0]
    else:
        distortion, corner, means2d = None, None, (tan_x, tan_y)
    means2d = jnp.stack([fx * means2d[0] + cx, fy * means2d[1] + cy], axis=-1)
    roots = _screen_roots(gaussians, camera, (tan_x, tan_y, z), distortion, corner)
    factors, variances, compensation = _filtered(*roots, effects)
    opacities = gaussians.opacities * compensation
    on_screen = jnp.all(jnp.abs(means2d) <= 10 * constants.MAX_SCREEN_SIGMA, axis=-1)
    visible = in_front & (opacities >= constants.ALPHA_MIN) & on_screen
    opacities = jnp.where(visible, opacities, 0.0)
    # alpha >= 1/255 exactly where the Mahalanobis distance is at most `reach`; the margin covers rounding.
    reach = jnp.sqrt(2.0 * jnp.log(jnp.maximum(jax.lax.stop_gradient(opacities) / constants.ALPHA_MIN, 1.0)))
    extents = 1.0001 * reach[..., None] * jnp.sqrt(jax.lax.stop_gradient(variances)) + 1e-3
    return Splats(
        means2d=jnp.where(visible[..., None], means2d, 0.0),
        conic_factors=jnp.where(visible[..., None], factors, 0.0),
        opacities=opacities,
        depths=z,
        radii=jnp.where(visible[..., None], extents, 0.0),
        visible=visible,
    )


def _corner(camera: Camera) -> Float[Array, " b"]:
    """Distance of the farthest image corner, margin included, from the axis: a tangent, as without distortion."""
    margin = 1 + constants.FRUSTUM_MARGIN
    fx, fy, cx, cy = (camera.Ks[:, i, j] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return margin * jnp.hypot(jnp.maximum(cx, camera.width - cx) / fx, jnp.maximum(cy, camera.height - cy) / fy)


def _screen_roots(gaussians: Gaussians, camera: Camera, points: tuple[Float[Array, "b n"], ...], distortion, corner):
    """Rows of M = J W R S, a square root of the screen covariance, each a triple of `[b n]`.

    `points` are x / z, y / z and z of the means in the camera, `corner` the undistorted radius of the farthest corner.
    """
    tan_x, tan_y, z = points
    fx, fy = (camera.Ks[:, i, i, None] for i in (0, 1))
    # A barrel lens sees farther than the pinhole image reaches: nothing is clamped up to there.
    wider = None if corner is None else jnp.maximum(corner / _corner(camera), 1.0)[:, None]
    low_x, high_x, low_y, high_y = tangent_bounds(camera, wider)
    tan_x, tan_y = jnp.clip(tan_x, low_x, high_x), jnp.clip(tan_y, low_y, high_y)
    world = camera.viewmats[:, :3, :3, None]  # b 3 3 1
    # Rows of J W: what a world displacement does to the pixel.
    to_u = [(world[:, 0, j] - tan_x * world[:, 2, j]) / z for j in range(3)]
    to_v = [(world[:, 1, j] - tan_y * world[:, 2, j]) / z for j in range(3)]
    if distortion is not None:
        xx, xy, yx, yy = distort(tan_x, tan_y, distortion)[1]
        to_u, to_v = ([a * u + b * v for u, v in zip(to_u, to_v, strict=True)] for a, b in ((xx, xy), (yx, yy)))
    to_u, to_v = [fx * u for u in to_u], [fy * v for v in to_v]
    rotation, scales = matrix_entries(gaussians.quats), columns(gaussians.scales)
    axes = [[rotation[j][k] * scales[k] for k in range(3)] for j in range(3)]  # columns are the scaled axes
    root_u = [sum(to_u[j] * axes[j][k] for j in range(3)) for k in range(3)]
    root_v = [sum(to_v[j] * axes[j][k] for j in range(3)) for k in range(3)]
    return root_u, root_v


def tangent_bounds(camera: Camera, wider: Float[Array, "b 1"] | None = None) -> tuple[Float[Array, "b 1"], ...]:
    """Left, right, upper and lower bound of the tangents at which the Jacobian is taken.

    Args:
        camera: one batch axis.
        wider: factor at least 1 by which each bound moves outwards, or None.
    """
    bounds = []
    for axis, size in ((0, camera.width), (1, camera.height)):
        focal, center = camera.Ks[:, axis, axis, None], camera.Ks[:, axis, 2, None]
        margin = constants.FRUSTUM_MARGIN * 0.5 * size / jnp.abs(focal)
        ends = -center / focal, (size - center) / focal  # a negative focal length, of a mirrored image, turns them
        low, high = jnp.minimum(*ends) - margin, jnp.maximum(*ends) + margin
        if wider is not None:
            low, high = jnp.minimum(low, wider * low), jnp.maximum(high, wider * high)
        bounds += [low, high]
    return tuple(bounds)


def _filtered(root_u, root_v, effects: Effects):
    """Conic factors, variances and opacity compensation of the screen covariance, filtered as `effects` say."""
    kernel = FILTER_VARIANCES[effects.antialias or "mip"]
    # In units of the largest entry nothing overflows at any scale; the unit is a constant to the gradient.
    largest = sum(jnp.abs(jax.lax.stop_gradient(m)) for m in (*root_u, *root_v))
    sized = largest <= constants.MAX_SCREEN_SIGMA
    unit = jnp.where(sized, jnp.maximum(largest, 1.0), 1.0)
    u, v = ([jnp.where(sized, m, 0.0) / unit for m in root] for root in (root_u, root_v))
    kernel = jnp.maximum(kernel / unit / unit, constants.MIN_RELATIVE_VARIANCE)
    uu, uv, vv = (sum(a * b for a, b in zip(p, q, strict=True)) for p, q in ((u, u), (u, v), (v, v)))
    cross = (u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0])
    det = sum(c * c for c in cross)
    # Back in pixels the filtered determinant is at least about the kernel: its inverse square stays in float32.
    det_filtered = (det + kernel * (uu + vv + kernel)) * unit * unit
    # Half the inverse of [[uu, uv], [uv, vv]] is R^T R with the triangular R = [[p, q], [0, r]].
    p = jnp.sqrt(0.5 * (vv + kernel) / det_filtered)
    factors = jnp.stack([p, -p * uv / (vv + kernel), jnp.sqrt(0.5 / (vv + kernel)) / unit], axis=-1)
    variances = jnp.stack([uu + kernel, vv + kernel], axis=-1) * (unit * unit)[..., None]
    if effects.antialias in ("classic", "none"):
        return factors, variances, jnp.where(sized, 1.0, 0.0).astype(unit.dtype)
    ratio = det * unit * unit / det_filtered
    keep = sized & (ratio > constants.MIN_COMPENSATION)
    return factors, variances, jnp.where(keep, jnp.sqrt(jnp.where(keep, ratio, 1.0)), 0.0)
