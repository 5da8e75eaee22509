"""The projection without lens distortion, with its gradient in closed form.

The chain rule by hand. Below, D x denotes dL/dx, for a Gaussian and a camera:

    det = |c|^2, c = u x v                      u, v: the rows of M = J W R S, in pixels
    a, b, d, e                                  D of u.u, u.v, v.v and det, from D of the conic and of the compensation
    D u = a u + b v + e (v x c)                 D v = d v + b u + e (c x u)
    D row_u = R S (D u)                         D row_v = R S (D v), of the rows of J W
    D S = R^T row_u D u + R^T row_v D v         axis by axis
    D turn = D row_u x row_u + D row_v x row_v  by a small rotation; D quat = 2 (0, D turn) quat / |quat|

The automatic gradient takes ten times as long as the projection itself: XLA fuses every entry of the result with all
that leads to it, so each repeats most of the work. Here the results of each line are kept (`cpu_backend.kept`).
"""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.cpu_backend import kept
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.core.numerics import columns, safe_normalize, with_rank_promotion
from ssplat_jax.core.pytree import replace
from ssplat_jax.core.rotations import matrix_entries
from ssplat_jax.rasterizer import constants
from ssplat_jax.rasterizer.effects import Effects, camera_points, near_planes
from ssplat_jax.rasterizer.projection import FILTER_VARIANCES, Splats, project, tangent_bounds

Entries = Sequence[Float[Array, "b n"]]
Pair = Sequence[Entries]


def project_pinhole(
    gaussians: Gaussians, camera: Camera, effects: Effects, near: Float[Array, " b"] | None = None
) -> Splats:
    """`project` without lens distortion: the same values, and the same gradient in a fraction of the time.

    Args:
        gaussians: the scene, finite.
        camera: one batch axis, usable.
        effects: the filter.
        near: as in `project`.

    Returns:
        Screen-space Gaussians. Gradients reach `means2d`, `conic_factors`, `opacities` and `depths`.

    Limits:
        Those of `project`. Second derivatives are taken forward over reverse, see `render`.
    """
    near = near_planes(gaussians, camera.viewmats) if near is None else near
    return _project(gaussians, camera, near, effects)  # pyright: ignore[reportReturnType] - custom_vjp hides the type


@functools.partial(jax.custom_vjp, nondiff_argnums=(3,))
def _project(gaussians: Gaussians, camera: Camera, near: Float[Array, " b"], effects: Effects):
    return project(gaussians, camera, effects, near=near)


def _project_fwd(gaussians: Gaussians, camera: Camera, near: Float[Array, " b"], effects: Effects):
    splats = project(gaussians, camera, effects, near=near)
    return splats, (gaussians, camera, near, splats)


@with_rank_promotion
def _project_bwd(effects: Effects, residuals, grads: Splats) -> tuple[Gaussians, Camera, Array]:
    gaussians, camera, near, splats = residuals
    visible = splats.visible
    grads = replace(
        grads,
        means2d=jnp.where(visible[..., None], grads.means2d, 0.0),
        conic_factors=jnp.where(visible[..., None], grads.conic_factors, 0.0),
        opacities=jnp.where(visible, grads.opacities, 0.0),
        visible=visible,
    )
    sight = _sight(gaussians, camera, near, visible)
    axes, scales = matrix_entries(gaussians.quats), columns(gaussians.scales)
    scales = [jnp.where(visible, scale, 0.0) for scale in scales]  # infinity times zero is kept out
    always = jnp.any(visible)  # where it is false, all gradients below are 0
    unscaled = kept([[sum(row[j] * axes[j][k] for j in range(3)) for k in range(3)] for row in sight.rows], always)
    roots = [[root * scale for root, scale in zip(part, scales, strict=True)] for part in unscaled]
    shape_grads = kept(_shape_grads(gaussians, splats, grads, roots, effects), always)
    root_grads = kept(_root_grads(roots, shape_grads), always)
    scaled = [[grad * scale for grad, scale in zip(part, scales, strict=True)] for part in root_grads]
    row_grads = kept([[sum(axes[j][k] * part[k] for k in range(3)) for j in range(3)] for part in scaled], always)
    scale_grads = [sum(root_grads[i][k] * unscaled[i][k] for i in (0, 1)) for k in range(3)]
    point_grads, clipped_grads = _point_grads(sight, camera, row_grads, grads)
    turns = [_cross(grad, row) for grad, row in zip(row_grads, sight.rows, strict=True)]
    turn = [jnp.sum(a + b, axis=0) for a, b in zip(*turns, strict=True)]
    world = camera.viewmats[:, :3, :3, None]
    by_gaussian = replace(
        gaussians,
        means=_stacked(sum(world[:, i, j] * point_grads[i] for i in range(3)) for j in range(3)),
        quats=_quat_grads(gaussians.quats, turn),
        scales=_stacked(scale_grads),
        opacities=jnp.sum(grads.opacities * _compensation(gaussians, splats), axis=0),
        sh=jnp.zeros_like(gaussians.sh),
    )
    by_camera = _camera_grads(gaussians, camera, sight, grads, row_grads, point_grads, clipped_grads)
    return by_gaussian, by_camera, jnp.zeros_like(near)


_project.defvjp(_project_fwd, _project_bwd)


class _Sight(NamedTuple):
    """Places of rows in front of a camera; harmless values for rows that are not visible."""

    in_front: Bool[Array, "b n"]
    depths: Float[Array, "b n"]
    tangents: Entries
    clipped: Entries  # tangents at which the Jacobian is taken
    is_low: Sequence[Bool[Array, "b n"]]  # clipped to the lower bound
    is_high: Sequence[Bool[Array, "b n"]]
    unfocused: Pair  # rows of J W over the focal length
    rows: Pair  # rows of J W


def _sight(gaussians: Gaussians, camera: Camera, near: Float[Array, " b"], visible: Bool[Array, "b n"]) -> _Sight:
    x, y, z = camera_points(gaussians.means, camera.viewmats)
    in_front = z > near[:, None]
    depths = jnp.where(in_front, z, 1.0)
    tangents = tuple(jnp.where(visible, point / depths, 0.0) for point in (x, y))
    low_x, high_x, low_y, high_y = tangent_bounds(camera)
    sides = list(zip(tangents, (low_x, low_y), (high_x, high_y), strict=True))
    clipped = tuple(jnp.clip(tangent, low, high) for tangent, low, high in sides)
    is_high = tuple(jnp.maximum(tangent, low) > high for tangent, low, high in sides)
    is_low = tuple((tangent < low) & ~high for (tangent, low, _), high in zip(sides, is_high, strict=True))
    world = camera.viewmats[:, :3, :3, None]
    unfocused = [[(world[:, i, j] - clipped[i] * world[:, 2, j]) / depths for j in range(3)] for i in (0, 1)]
    rows = [[camera.Ks[:, i, i, None] * entry for entry in unfocused[i]] for i in (0, 1)]
    return _Sight(in_front, depths, tangents, clipped, is_low, is_high, unfocused, rows)


def _compensation(gaussians: Gaussians, splats: Splats) -> Float[Array, "b n"]:
    """Opacity on the screen over that in the scene; 0 where a row is not visible."""
    return jnp.where(splats.visible, splats.opacities / jnp.where(splats.visible, gaussians.opacities, 1.0), 0.0)


def _shape_grads(gaussians: Gaussians, splats: Splats, grads: Splats, roots, effects: Effects):
    """Gradients a, b, d, e with respect to u.u (twice), u.v, v.v (twice) and det (twice).

    The filtered v.v is 1 / (2 r^2) and the filtered determinant 1 / (4 p^2 r^2): all is in the factors already.
    """
    p, q, r = columns(splats.conic_factors)
    by_p, by_q, by_r = columns(grads.conic_factors)
    kernel = FILTER_VARIANCES[effects.antialias or "mip"]
    if kernel < constants.MIN_RELATIVE_VARIANCE * constants.MAX_SCREEN_SIGMA**2:  # large rows have a larger one
        largest = sum(jnp.abs(jax.lax.stop_gradient(root)) for part in roots for root in part)
        kernel = jnp.maximum(kernel, constants.MIN_RELATIVE_VARIANCE * largest * largest)
    along_p = by_p * p + by_q * q
    by_compensation = over_compensation = 0.0  # times the compensation, and divided by it
    if effects.antialias in (None, "mip"):
        compensation = jnp.where(splats.visible, _compensation(gaussians, splats), 1.0)
        by_compensation = grads.opacities * splats.opacities
        over_compensation = grads.opacities * gaussians.opacities / compensation
    weight, squared_r = 2 * p * p * r * r, r * r
    total = along_p + by_compensation
    a = -2 * kernel * weight * total
    d = a + 2 * squared_r * (along_p - 2 * by_q * q - by_r * r)
    return a, -2 * by_q * p * squared_r, d, 2 * weight * (over_compensation - total)


def _root_grads(roots, shape_grads):
    """Gradients with respect to u and v."""
    (u, v), (a, b, d, e) = roots, shape_grads
    cross = _cross(u, v)
    by_u = [a * x + b * y + e * side for x, y, side in zip(u, v, _cross(v, cross), strict=True)]
    by_v = [d * y + b * x + e * side for x, y, side in zip(u, v, _cross(cross, u), strict=True)]
    return by_u, by_v


def _point_grads(sight: _Sight, camera: Camera, row_grads, grads: Splats):
    """Gradients with respect to x, y and z in the camera, and those of the clipped tangents alone."""
    world = camera.viewmats[:, :3, :3, None]
    focal = [camera.Ks[:, i, i, None] for i in (0, 1)]
    behind = [world[:, 2, j] for j in range(3)]
    clipped = [-focal[i] * _dot(row_grads[i], behind) / sight.depths for i in (0, 1)]
    inside = [~(low | high) for low, high in zip(sight.is_low, sight.is_high, strict=True)]
    pixels = columns(grads.means2d)
    tangents = [focal[i] * pixels[i] + jnp.where(inside[i], clipped[i], 0.0) for i in (0, 1)]
    shrink = sum(_dot(row_grads[i], sight.rows[i]) + tangents[i] * sight.tangents[i] for i in (0, 1))
    by_depth = jnp.where(sight.in_front, grads.depths, 0.0) - shrink / sight.depths
    return [*(tangent / sight.depths for tangent in tangents), by_depth], clipped


def _quat_grads(quats: Float[Array, "n 4"], turn) -> Float[Array, "n 4"]:
    """Gradients of quaternions of any length, from those of a small rotation about the axes of the world."""
    unit = columns(safe_normalize(quats))
    length = jnp.sqrt(sum(entry * entry for entry in columns(quats)))
    is_zero = functools.reduce(jnp.maximum, (jnp.abs(entry) for entry in unit)) == 0
    w, *axis = [jnp.where(is_zero, one, entry) for one, entry in zip((1.0, 0.0, 0.0, 0.0), unit, strict=True)]
    inverse = jnp.where(is_zero, 0.0, 1.0 / jnp.where(is_zero, 1.0, length))  # of the length
    side = _cross(turn, axis)
    entries = [-_dot(turn, axis), *(w * a + b for a, b in zip(turn, side, strict=True))]
    return jnp.stack([2 * inverse * entry for entry in entries], axis=-1)


def _camera_grads(gaussians, camera: Camera, sight: _Sight, grads: Splats, row_grads, point_grads, clipped_grads):
    """Camera gradients, summed over Gaussians; removed by XLA if unused."""
    total = lambda x: jnp.sum(x, axis=1)  # noqa: E731
    means, focal = columns(gaussians.means), [camera.Ks[:, i, i, None] for i in (0, 1)]
    world = [[total(point_grads[i] * means[j]) for j in range(3)] for i in range(3)]
    for j in range(3):
        across = [focal[i] * row_grads[i][j] / sight.depths for i in (0, 1)]
        world[0][j] += total(across[0])
        world[1][j] += total(across[1])
        world[2][j] -= total(sum(clipped * grad for clipped, grad in zip(sight.clipped, across, strict=True)))
    rows = [jnp.stack([*world[i], total(point_grads[i])], axis=-1) for i in range(3)]
    pixels, zero = columns(grads.means2d), jnp.zeros_like(focal[0][:, 0])
    by_focal = [total(pixels[i] * sight.tangents[i] + _dot(row_grads[i], sight.unfocused[i])) for i in (0, 1)]
    intrinsics = [(by_focal[0], zero, total(pixels[0])), (zero, by_focal[1], total(pixels[1])), (zero, zero, zero)]
    by_bounds = []
    for i in (0, 1):
        for is_clipped in (sight.is_low[i], sight.is_high[i]):
            by_bounds.append(total(jnp.where(is_clipped, clipped_grads[i], 0.0))[:, None])
    (by_margin,) = jax.vjp(tangent_bounds, camera)[1](tuple(by_bounds))
    return replace(
        camera,
        viewmats=jnp.stack([*rows, jnp.zeros_like(rows[0])], axis=1),
        Ks=jnp.stack([jnp.stack(row, axis=-1) for row in intrinsics], axis=1) + by_margin.Ks,
    )


def _stacked(entries) -> Float[Array, "n k"]:
    """Sums over the cameras as columns."""
    return jnp.stack([jnp.sum(entry, axis=0) for entry in entries], axis=-1)


def _dot(a, b) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a, b) -> list[Array]:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
