"""Projection of one view's cells, at every candidate depth, into another view."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ssplat_jax.core.cameras import invert_poses, pixel_grid, unproject
from ssplat_jax.model.types import Views

MIN_SOURCE_DEPTH = 1e-3
"""Smallest depth in a source camera, relative to the candidate's depth, at which the source sees a candidate."""


def sweep_pixels(
    views: Views, reference, source, stride: int
) -> tuple[Float[Array, "d n"], Float[Array, "d n"], Bool[Array, "d n"]]:
    """Pixels in view `source` of the cells of view `reference`, at every candidate depth.

    Args:
        views: the chunk's views.
        reference: index of the view whose cells are projected.
        source: index of the view that they are projected into.
        stride: pixels per side of a cell.

    Returns:
        x and y in pixels of the padded image, and whether the source image contains them, by candidate and cell.
    """
    height, width = views.images.shape[1:3]
    cells = pixel_grid(height, width, stride).reshape(-1, 2)
    rays = unproject(cells, jnp.ones(cells.shape[0]), views.Ks[reference])
    exact = jax.lax.Precision.HIGHEST
    pose = jnp.matmul(views.viewmats[source], invert_poses(views.viewmats[reference]), precision=exact)
    # A point at depth d on the ray r projects to K R r + K t / d: rays are rotated once, and without parallax every
    # depth gives the same pixel to the last bit.
    a = jnp.einsum("ij,jk,nk->in", views.Ks[source], pose[:3, :3], rays, precision=exact)
    b = jnp.einsum("ij,j->i", views.Ks[source], pose[:3, 3], precision=exact)
    nearness = jnp.exp(-views.log_candidates)[:, None]
    x, y, w = (a[i] + nearness * b[i] for i in range(3))
    in_front = w > MIN_SOURCE_DEPTH * nearness
    w = jnp.where(in_front, w, 1.0)
    x, y = x / w, y / w
    return x, y, in_front & (x >= 0) & (x <= views.width) & (y >= 0) & (y <= views.height)
