"""Token positions and colors from depth maps and images (Sec. 3.3)."""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from ssplat_jax.config import StreamConfig
from ssplat_jax.core.cameras import invert_poses, pixel_grid, transform_points, unproject
from ssplat_jax.model.layers import average_pool
from ssplat_jax.model.types import GRID_STRIDE, Views


def patch_colors(images: Float[Array, "v h w 3"], config: StreamConfig) -> Float[Array, "v hf wf a"]:
    """Appearance anchors: mean colors of the `gaussians_per_token` parts of each token's patch, row by row."""
    side = math.isqrt(config.head.gaussians_per_token)
    parts = average_pool(images, GRID_STRIDE // side)
    v, h, w, _ = parts.shape
    parts = parts.reshape(v, h // side, side, w // side, side, 3).swapaxes(2, 3)
    return parts.reshape(v, h // side, w // side, 3 * side * side)


def back_project(
    log_depths: Float[Array, "v hf wf"], views: Views
) -> tuple[Float[Array, "v hf wf 3"], Float[Array, "v hf wf"]]:
    """World positions p_j of the cells at their depths, and their footprints: the side of a cell at that depth."""
    v, hf, wf = log_depths.shape
    cells = pixel_grid(hf * GRID_STRIDE, wf * GRID_STRIDE, GRID_STRIDE).reshape(-1, 2)
    depths = jnp.exp(log_depths).reshape(v, -1)
    points = unproject(jnp.broadcast_to(cells, (v, *cells.shape)), depths, views.Ks)
    world = transform_points(invert_poses(views.viewmats), points)
    focal = 0.5 * (views.Ks[:, 0, 0] + views.Ks[:, 1, 1])
    return world.reshape(v, hf, wf, 3), (depths * GRID_STRIDE / focal[:, None]).reshape(v, hf, wf)
