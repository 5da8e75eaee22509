"""Sightings: how often views saw a pivot, saw through it or did not see it, and how well its color fitted there.

This is an addition to the paper's VACC. A cell of a chunk's view whose depth is trusted says three things about a pivot
that projects to it: whether the pivot lies on the cell's surface, before or behind it, how far from it, and what color it
should have. Sums of these, over all views since the pivot was written, are what its token alone cannot know. The decoder
reads them (`model/evidence_head.py`).
"""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ssplat_jax.numerics import safe_log
from ssplat_jax.pytree import pytree

ON_SURFACE = math.log(1.03)
"""Largest distance in log depth at which a pivot lies on the surface of a cell."""

NUM_SIGHTINGS = 6
"""Numbers for each pivot; see `Sightings`."""


@pytree
class Sightings:
    """Sums over the cells that `n` pivots project to, each weighted by the confidence of the cell's depth."""

    on: Float[Array, " n"]  # the pivot lies on the cell's surface
    before: Float[Array, " n"]  # the cell sees through the pivot
    behind: Float[Array, " n"]  # the pivot is hidden
    error_on: Float[Array, " n"]  # mean absolute difference of colors where it lies on the surface
    error_before: Float[Array, " n"]  # where the cell sees through it
    offset_on: Float[Array, " n"]  # log depth less the cell's, in units of `ON_SURFACE`, where it lies on the surface


def empty_sightings(capacity: int, pivots_per_voxel: int) -> Float[Array, "capacity k s"]:
    """Zero sightings of all pivots of a cache."""
    return jnp.zeros((capacity, pivots_per_voxel, NUM_SIGHTINGS))


def unpack_sightings(packed: Float[Array, "n s"]) -> Sightings:
    """The columns of the array that the cache holds."""
    return Sightings(*jnp.moveaxis(packed, -1, 0))


def sightings_of(
    pixels: Int[Array, " p"],
    depths: Float[Array, " p"],
    colors: Float[Array, "n 3"],
    weights: Float[Array, " c"],
    log_depths: Float[Array, " c"],
    cell_colors: Float[Array, "c 3"],
    num_views: int,
) -> Float[Array, "n s"]:
    """Sums of what the cells of `num_views` views say about `n` points.

    Args:
        pixels: cell of each pair of view and point, view-major, flat over all views; the number of cells if the point is not
            seen.
        depths: log depth of the point in each pair.
        colors: of the points, at the exposure of the scene.
        weights: confidence of each cell, flat over all views; 0 for a cell without a trusted depth.
        log_depths: of each cell.
        cell_colors: of each cell, at the exposure of the scene.
        num_views: number of views.
    """
    read = lambda x: x.at[pixels].get(mode="fill", fill_value=0.0)  # noqa: E731
    by_view = lambda x: x.reshape(num_views, -1)  # noqa: E731
    weight = by_view(read(weights))
    offset = by_view(depths - read(log_depths)) / ON_SURFACE
    # One channel at a time: rows of three do not vectorize on a CPU.
    error = sum(jnp.abs(by_view(read(cell_colors[:, i])) - colors[:, i]) for i in range(3)) / 3
    on = jnp.where(jnp.abs(offset) <= 1, weight, 0.0)
    before, behind = jnp.where(offset < -1, weight, 0.0), jnp.where(offset > 1, weight, 0.0)
    sums = (on, before, behind, on * error, before * error, on * jnp.where(jnp.abs(offset) <= 1, offset, 0.0))
    return jnp.stack([jnp.sum(x, axis=0) for x in sums], axis=-1)


def features_of_sightings(packed: Float[Array, "n s"]) -> Float[Array, "n f"]:
    """What sightings say, as numbers of about unit size.

    Limits:
        Zeros, as for a pivot that no trusted cell has seen, give finite features; gradients are those of the logarithms,
        which are bounded.
    """
    s = unpack_sightings(jax.lax.stop_gradient(packed))
    seen = s.on + s.before
    total = jnp.maximum(seen + s.behind, 1e-3)
    error = (s.error_on + s.error_before) / jnp.maximum(seen, 1e-3)
    features = (
        jnp.log1p(s.on) - 1.5,
        jnp.log1p(s.before) - 0.5,
        jnp.log1p(s.behind) - 0.5,
        4 * (s.before / total - 0.15),
        4 * (s.behind / total - 0.15),
        safe_log(0.01 + s.error_on / jnp.maximum(s.on, 1e-3)) + 3.0,
        safe_log(0.01 + error) + 3.0,
        3 * s.offset_on / jnp.maximum(s.on, 1e-3),
    )
    return jnp.stack(features, axis=-1)
