"""Where the cells of one view, put at every candidate depth, appear in another (ALGORITHM 2.6)."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ssplat_jax.geometry.cameras import invert_poses, pixel_grid, unproject
from ssplat_jax.model.types import Views

MIN_SOURCE_DEPTH = 1e-3
"""A candidate nearer than this to the source camera's plane, or behind it, is not seen by it."""


def sweep_pixels(
    views: Views, reference, source, stride: int
) -> tuple[Float[Array, "d n"], Float[Array, "d n"], Bool[Array, "d n"]]:
    """Where cells of `stride` pixels of view `reference`, at every candidate depth, appear in view `source`.

    Returns x, y (pixels) and whether the source sees it.
    """
    height, width = views.images.shape[1:3]
    cells = pixel_grid(height, width, stride).reshape(-1, 2)
    rays = unproject(cells, jnp.ones(cells.shape[0]), views.Ks[reference])
    exact = jax.lax.Precision.HIGHEST
    pose = jnp.matmul(views.viewmats[source], invert_poses(views.viewmats[reference]), precision=exact)
    # At depth d along a ray r, a point is imaged at K R r + K t / d: the rays are turned once, and without parallax
    # every depth gives the same pixel to the last bit.
    a = jnp.einsum("ij,jk,nk->in", views.Ks[source], pose[:3, :3], rays, precision=exact)
    b = jnp.einsum("ij,j->i", views.Ks[source], pose[:3, 3], precision=exact)
    nearness = jnp.exp(-views.log_candidates)[:, None]
    x, y, w = (a[i] + nearness * b[i] for i in range(3))
    in_front = w > MIN_SOURCE_DEPTH * nearness
    w = jnp.where(in_front, w, 1.0)
    x, y = x / w, y / w
    return x, y, in_front & (x >= 0) & (x <= views.width) & (y >= 0) & (y <= views.height)


def upstream_sweep_pixels(
    views: Views, reference, source, stride: int
) -> tuple[Float[Array, "d n"], Float[Array, "d n"]]:
    """The same as DepthSplat computes it, in samples of the maps: x, y, for any depth in front or behind.

    Cells are at whole numbers, which are the pixels' corners. (It gives both views the intrinsics of `reference`,
    which no weights need.)
    """
    height, width = (side // stride for side in views.images.shape[1:3])
    exact = jax.lax.Precision.HIGHEST
    K, source_K = views.Ks[jnp.stack([reference, source])] * jnp.array([1.0 / stride, 1.0 / stride, 1.0])[:, None]
    corners = pixel_grid(height, width, 1).reshape(-1, 2) - 0.5
    rays = unproject(corners, jnp.ones(len(corners)), K)
    pose = jnp.matmul(views.viewmats[source], invert_poses(views.viewmats[reference]), precision=exact)
    turned = jnp.einsum("ij,nj->in", pose[:3, :3], rays, precision=exact)
    points = jnp.exp(views.log_candidates)[None, :, None] * turned[:, None] + pose[:3, 3, None, None]
    x, y, w = jnp.einsum("ij,jdn->idn", source_K, points, precision=exact)
    w = jnp.maximum(w, MIN_SOURCE_DEPTH)
    return x / w, y / w
