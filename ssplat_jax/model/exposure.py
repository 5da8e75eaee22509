"""Exposure of each view relative to the scene, so that the cache stores colors at one exposure (ours).

Exposure and white balance drift over a video, by a factor of two on redkitchen. Stored as they come, the colors of one
surface would differ from patch to patch and match no view. A view's exposure is the median ratio, per channel, of its
colors to the cached colors, over the cells where both see the same surface. The scene has the exposure of the first
views.
"""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ssplat_jax.cache.project import ProjectedCache
from ssplat_jax.cache.votes import SAME_SURFACE_MARGIN
from ssplat_jax.config import StreamConfig
from ssplat_jax.core.numerics import safe_log
from ssplat_jax.model.layers import average_pool
from ssplat_jax.model.views import GRID_STRIDE, Views

MIN_COLOR, MAX_COLOR = 0.03, 0.97
"""Range of colors that are about proportional to exposure: darker cells are noise, brighter ones are clipped."""
MIN_CELLS = 64
"""Cells that a view must share with the scene. With fewer, the mean over the other views is more reliable."""
MAX_EXPOSURE = 4.0  # upper bound of an exposure; the lower bound is its reciprocal


def estimate_exposures(
    history: ProjectedCache,
    log_depths: Float[Array, "v hf wf"],
    confidences: Float[Array, "v hf wf"],
    views: Views,
    config: StreamConfig,
) -> Float[Array, "v 3"]:
    """Exposure of each view: the factor per channel from the scene's colors to the view's. Not differentiated.

    Cells whose confidence is below `min_confidence` are not compared.

    Limits:
        Factors lie in [1/4, 4].
        A view that shares fewer than `MIN_CELLS` cells with the scene gets the geometric mean of the views that share
        enough; 1 if there is none.
        Cells with values that are not finite are not compared.
    """
    cached = history.colors
    if cached is None or not config.stream.match_exposure:
        return jnp.ones((len(views.viewmats), 3))
    seen = average_pool(views.images, GRID_STRIDE)
    cached_log_depths = safe_log(jnp.where(history.mask, history.depths, 1.0))
    is_compared = (
        history.mask
        & views.inside
        & (confidences >= config.memory.min_confidence)
        & (jnp.abs(log_depths - cached_log_depths) <= SAME_SURFACE_MARGIN)
        & ((seen >= MIN_COLOR) & (seen <= MAX_COLOR) & (cached >= MIN_COLOR)).all(axis=-1)
    )
    ratios = jnp.where(is_compared[..., None], seen, 1.0) / jnp.where(is_compared[..., None], cached, 1.0)
    logs, is_known = _medians(safe_log(ratios), is_compared)
    logs = jnp.where(is_known, jnp.clip(logs, -math.log(MAX_EXPOSURE), math.log(MAX_EXPOSURE)), 0.0)
    mean_log = logs.sum(axis=0) / jnp.maximum(is_known.sum(dtype=jnp.float32), 1.0)
    return jax.lax.stop_gradient(jnp.exp(jnp.where(is_known, logs, mean_log)))


def _medians(values, is_counted):
    """Upper median of the counted cells per view and channel, and whether there are enough of them."""
    v = len(values)
    ordered = jnp.sort(jnp.where(is_counted[..., None], values, jnp.inf).reshape(v, -1, 3), axis=1)
    num_cells = is_counted.sum(axis=(1, 2))[:, None]
    middle = jnp.take_along_axis(ordered, (num_cells // 2)[:, :, None], axis=1)[:, 0]
    return middle, num_cells >= MIN_CELLS
