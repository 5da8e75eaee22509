"""Residuals of key views against the scene, explained by what may be wrong with a view: pose, focal length, exposure.

The residual of a view is fitted by least squares in float64 NumPy. With the rendered color I, its image gradient, the
rendered depth Z and the flow of a small motion of the camera,

    target / exposure - I  ≈  I log_gain - ∇I · flow(twist, log_focal)

over the pixels that the scene covers. One such fit is a Gauss-Newton step of direct image alignment.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ssplat_jax.cache.key_views import KeyViews
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.rasterizer import Effects, render
from ssplat_jax.refinement.view_revision import median_depths

COVERED = 0.8
"""Alpha above which a pixel counts as covered by the scene."""
SMALLEST_SHARE = 0.05
"""Share of an image that must be covered for a fit."""
GAINS, TWIST, FOCAL = [0, 1, 2], [3, 4, 5, 6, 7, 8], 9
"""Places of the unknowns of a fit."""
TRIMMED = 0.2
"""Share of the covered pixels that a fit leaves out: those of the largest residuals, mostly occlusions."""


@dataclasses.dataclass(frozen=True)
class ViewResiduals:
    """The fits of `v` key views. Rows of views that could not be fitted are NaN."""

    views: list[int]  # slots of the key views
    errors: Float[np.ndarray, " v"]  # mean absolute error over the covered pixels, in units of the target's color
    explained: Float[np.ndarray, "v 3"]  # shares of the squared residual after gains that focal, pose and both explain
    log_gains: Float[np.ndarray, "v 3"]  # log of the factor that the view's exposure lacks
    twists: Float[np.ndarray, "v 6"]  # motion of the camera, as in `view_revision.moved_viewmat`
    log_focals: Float[np.ndarray, " v"]  # log of the factor that the focal length lacks


def view_residuals(gaussians: Gaussians, key_views: KeyViews, views: Sequence[int] | None = None) -> ViewResiduals:
    """Fits of key views, rendered one by one. It looks at values: call it outside jit.

    Args:
        gaussians: the scene.
        key_views: the views to compare with.
        views: slots to look at; by default all valid ones.
    """
    chosen = [int(i) for i in np.flatnonzero(np.asarray(key_views.valid))] if views is None else list(views)
    depths = np.asarray(median_depths(gaussians, key_views.viewmats[np.array(chosen, int)]))
    rows = [_fit_view(gaussians, key_views, i, float(d)) for i, d in zip(chosen, depths, strict=True)]
    columns = np.array(rows, np.float64).reshape(-1, 14)
    return ViewResiduals(
        views=chosen,
        errors=columns[:, 0],
        explained=columns[:, 1:4],
        log_gains=columns[:, 4:7],
        twists=columns[:, 7:13],
        log_focals=columns[:, 13],
    )


def _fit_view(gaussians: Gaussians, key_views: KeyViews, view: int, depth: float) -> list[float]:
    """Error, explained shares, log gains, twist and log focal of one view."""
    exposure = np.asarray(key_views.exposures[view], np.float64)
    camera = key_views.camera(view)
    is_sound = np.all(np.isfinite(exposure)) and np.all(exposure > 0)
    if not is_sound or not all(np.all(np.isfinite(np.asarray(x))) for x in (camera.viewmats, camera.Ks)):
        return [np.nan] * 14
    out = render(gaussians, camera, effects=Effects(outputs=("color", "alpha", "depth")))
    color, alpha, z = (np.asarray(x, np.float64) for x in (out.color, out.alpha, out.depth))
    covered = (alpha > COVERED) & (z > 0)
    if covered.mean() < SMALLEST_SHARE:
        return [np.nan] * 14
    # The color is completed if a little light is missing, so that thin cover does not read as a dark exposure.
    color = color / np.where(covered, alpha, 1.0)[..., None]
    residual = np.asarray(key_views.images[view], np.float64) / 255 / exposure - color
    columns = _columns(color, z, np.asarray(camera.Ks, np.float64), depth)
    size = np.mean(np.abs(residual), axis=-1)
    kept = covered & (size <= np.quantile(size[covered], 1 - TRIMMED))
    solution, explained = _solve(columns[kept], residual[kept])
    error = float(np.mean(np.abs(residual[covered]) * exposure))
    return [error, *explained, *solution]


def _columns(
    color: Float[np.ndarray, "h w 3"], z: Float[np.ndarray, "h w"], K: Float[np.ndarray, "3 3"], depth: float
) -> Float[np.ndarray, "h w 3 10"]:
    """Derivatives of every pixel's color with respect to log gains, twist and log focal length."""
    h, w = z.shape
    x = (np.arange(w) + 0.5 - K[0, 2])[None, :] / K[0, 0] + np.zeros((h, 1))
    y = (np.arange(h) + 0.5 - K[1, 2])[:, None] / K[1, 1] + np.zeros((1, w))
    ratio, one, zero = depth / np.where(z > 0, z, np.inf), np.ones((h, w)), np.zeros((h, w))
    # Motion of a point (x, y, 1) z under the twist, over z, projected: (dx - x dz, dy - y dz).
    moves_x = [-x * y, one + x * x, -y, ratio, zero, -x * ratio, x]
    moves_y = [-one - y * y, x * y, x, zero, ratio, -y * ratio, y]
    flow = np.stack([K[0, 0] * np.stack(moves_x, -1), K[1, 1] * np.stack(moves_y, -1)], -1)  # [h w 7 2]
    slopes = np.stack([np.gradient(color, axis=1), np.gradient(color, axis=0)], -1)  # [h w 3 2]
    gains = color[..., None] * np.eye(3)
    return np.concatenate([gains, -np.einsum("hwcd,hwpd->hwcp", slopes, flow)], axis=-1)


def _solve(columns: Float[np.ndarray, "m 3 10"], residual: Float[np.ndarray, "m 3"]) -> tuple[np.ndarray, list[float]]:
    """Least squares, with a small ridge for what an image cannot tell apart.

    Returns:
        The solution: log gains of the fit of everything, the twist of a fit of gains and pose, and the log focal length
        of a fit of gains and focal length. Then three shares of the squared residual that gains alone leave: those that
        focal length, pose, and both together explain.
    """
    a, b = columns.reshape(-1, columns.shape[-1]), residual.reshape(-1)
    size = np.sqrt(np.mean(a * a, axis=0)) + 1e-12
    a = a / size
    normal, target = a.T @ a + 1e-4 * len(a) * np.eye(a.shape[1]), a.T @ b
    fits, left = [], []
    for parts in (GAINS, [*GAINS, FOCAL], [*GAINS, *TWIST], [*GAINS, *TWIST, FOCAL]):
        fit = np.zeros(a.shape[1])
        fit[parts] = np.linalg.solve(normal[np.ix_(parts, parts)], target[parts])
        fits.append(fit / size)
        left.append(float(np.sum((b - a @ fit) ** 2)))
    solution = np.concatenate([fits[3][GAINS], fits[2][TWIST], fits[1][[FOCAL]]])
    return solution, [1 - rest / max(left[0], 1e-30) for rest in left[1:]]
