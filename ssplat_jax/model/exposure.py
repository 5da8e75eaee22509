"""Exposure: every view against the scene (ours), so that the cache remembers colors at one exposure.

Exposure and white balance of a camera drift over a video, by a factor of two on redkitchen; remembered as they come,
the colors of one surface differ from patch to patch and fit no view. A view's exposure is, per channel, the median
ratio of the colors it sees to those that the cache remembers, over the cells where both see the same surface. The
scene keeps the exposure of the first views.
"""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ssplat_jax.cache import SAME_SURFACE, ProjectedCache
from ssplat_jax.config import StreamConfig
from ssplat_jax.model.layers import average_pool
from ssplat_jax.model.types import GRID_STRIDE, Views
from ssplat_jax.numerics import safe_log

DARKEST, BRIGHTEST = 0.03, 0.97  # colors between which an image is about proportional to the exposure
FEWEST_CELLS = 64  # fewer tell less than the neighboring views do
MOST = 4.0  # the largest exposure, and one over the smallest


def estimate_exposures(
    history: ProjectedCache,
    log_depths: Float[Array, "v hf wf"],
    confidences: Float[Array, "v hf wf"],
    views: Views,
    config: StreamConfig,
) -> Float[Array, "v 3"]:
    """What takes the scene's colors to those of each view; a constant for differentiation.

    Args:
        history: the projected cache.
        log_depths: of what each cell sees.
        confidences: of those depths; cells below `min_confidence` are not compared.

    Limits:
        A view that shares fewer than 64 cells with the scene has the mean (of logs) of those that do; without any, 1.
        Always in [1/4, 4]; cells that are not finite are not compared.
    """
    remembered = history.colors
    if remembered is None:
        return jnp.ones((len(views.viewmats), 3))
    seen = average_pool(views.images, GRID_STRIDE)
    remembered_log_depths = safe_log(jnp.where(history.mask, history.depths, 1.0))
    is_compared = (
        history.mask
        & views.inside
        & (confidences >= config.memory.min_confidence)
        & (jnp.abs(log_depths - remembered_log_depths) <= SAME_SURFACE)
        & ((seen >= DARKEST) & (seen <= BRIGHTEST) & (remembered >= DARKEST)).all(axis=-1)
    )
    ratios = jnp.where(is_compared[..., None], seen, 1.0) / jnp.where(is_compared[..., None], remembered, 1.0)
    logs, is_known = _medians(safe_log(ratios), is_compared)
    logs = jnp.where(is_known, jnp.clip(logs, -math.log(MOST), math.log(MOST)), 0.0)
    of_others = logs.sum(axis=0) / jnp.maximum(is_known.sum(dtype=jnp.float32), 1.0)
    return jax.lax.stop_gradient(jnp.exp(jnp.where(is_known, logs, of_others)))


def _medians(values, is_counted):
    """Per view and channel the median (of an even number the upper) of the counted cells, and whether they suffice."""
    v = len(values)
    ordered = jnp.sort(jnp.where(is_counted[..., None], values, jnp.inf).reshape(v, -1, 3), axis=1)
    number = is_counted.sum(axis=(1, 2))[:, None]
    middle = jnp.take_along_axis(ordered, (number // 2)[:, :, None], axis=1)[:, 0]
    return middle, number >= FEWEST_CELLS
