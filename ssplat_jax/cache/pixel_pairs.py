"""Pairs of a view and a pivot: the pixel in which the view sees the pivot, and the depth.

`project`, `carve` and `add_sightings` fold over the pairs. A view sees a small part of a large scene, so the rows that
some view sees are listed first, and only they are read again: all but the listing takes time in proportion to the
pivots in sight, not to those of the scene. Rows keep their order, so that sums run in row order.
"""

import math
from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ssplat_jax.cache.state import VoxelCache
from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.pytree import pytree

NEAR = 0.01
"""Near plane: pivots at or before this camera z (stream units) are invisible, as in the renderer."""

ROWS_PER_BLOCK = 4096
"""Most cache rows that are projected at a time."""

State = TypeVar("State")


@pytree
class PixelPairs:
    """Pairs (view, point), flattened: the pixel and the depth at which the view sees the point."""

    pixels: Int[Array, " p"]  # flat over all views; the number of pixels if the point is not seen
    log_depths: Float[Array, " p"]
    weights: Float[Array, " p"]  # 0 if the point is not seen


@pytree
class RowsInSight:
    """Cache rows with a pivot that a view sees, in their order."""

    rows: Int[Array, " c"]  # 0 where there is no further one
    number: Int[Array, ""]


def rows_in_sight(cache: VoxelCache, camera: Camera, *, min_confidence: float = 0.0) -> RowsInSight:
    """The rows of `cache` with a pivot of at least `min_confidence` whose center falls into a view of `camera`."""
    block = _block_length(cache)

    def mark(i, marks):
        means, confidences, counts = (jax.lax.dynamic_slice_in_dim(x, i * block, block) for x in _read(cache))
        pairs = _project(means, confidences, counts, camera, min_confidence)
        is_seen = (pairs.weights > 0).reshape(len(camera.viewmats), block, -1).any(axis=(0, 2))
        return jax.lax.dynamic_update_slice_in_dim(marks, is_seen, i * block, axis=0)

    num_blocks = (cache.num_voxels + block - 1) // block  # the occupied rows are the first ones
    marks = jax.lax.fori_loop(0, num_blocks, mark, jnp.zeros(cache.capacity, bool))
    ends, numbers = jnp.cumsum(marks, dtype=jnp.int32), jnp.arange(cache.capacity, dtype=jnp.int32)
    rows = jnp.zeros_like(numbers).at[jnp.where(marks, ends - 1, cache.capacity)].set(numbers, mode="drop")
    return RowsInSight(rows=rows, number=ends[-1])


def fold_pairs(
    cache: VoxelCache,
    camera: Camera,
    in_sight: RowsInSight,
    visit: Callable[[State, PixelPairs, Int[Array, " n"], Bool[Array, " n"]], State],
    start: State,
    *,
    min_confidence: float = 0.0,
) -> State:
    """Folds `visit(state, pairs, rows, is_row)` over blocks of the rows in sight.

    Args:
        cache: holds the pivots.
        camera: a batch of views.
        in_sight: the rows that are visited, of the same cache and views.
        visit: takes the state, the `v * n * k` pairs of a block of n rows, view-major, the numbers of the rows, and
            which of them are rows: the last block is filled up with row 0, whose pairs are then not seen.
        start: the state before the first block.
        min_confidence: pivots below it are not seen.
    """
    block = _block_length(cache)

    def step(i, state):
        rows = jax.lax.dynamic_slice_in_dim(in_sight.rows, i * block, block)
        is_row = i * block + jnp.arange(block, dtype=jnp.int32) < in_sight.number
        means, confidences, counts = (rows_of(x, rows) for x in _read(cache))
        pairs = _project(means, confidences, jnp.where(is_row, counts, 0), camera, min_confidence)
        return visit(state, pairs, rows, is_row)

    return jax.lax.fori_loop(0, (in_sight.number + block - 1) // block, step, start)


def rows_of(x: Array, rows: Int[Array, " n"]) -> Array:
    """`x[rows]` for row numbers that are valid."""
    return x.at[rows].get(mode="promise_in_bounds")


def places_of(rows: Int[Array, " n"], is_row: Bool[Array, " n"], cache: VoxelCache) -> Int[Array, " n"]:
    """`rows` as targets of a scatter that drops those that are no rows."""
    return jnp.where(is_row, rows, cache.capacity)


def _block_length(cache: VoxelCache) -> int:
    return math.gcd(cache.capacity, ROWS_PER_BLOCK)


def _read(cache: VoxelCache) -> tuple[Array, Array, Array]:
    return cache.means, cache.confidences, cache.counts


def _project(means, confidences, counts, camera: Camera, min_confidence: float) -> PixelPairs:
    """Pairs of all views with the pivots of some rows: `means` [n k 3], `confidences` [n k], `counts` [n]."""
    is_visible = (jnp.arange(means.shape[1]) < counts[:, None]) & (confidences >= min_confidence)
    return project_points(means.reshape(-1, 3), jnp.where(is_visible, confidences, 0.0).reshape(-1), camera)


def project_points(points: Float[Array, "n 3"], weights: Float[Array, " n"], camera: Camera) -> PixelPairs:
    """Pairs of all views with `points`, view-major; points of weight 0 or NaN are not seen."""
    # Written out per coordinate: three rows of products vectorize over the points, a 3 x 3 matrix product does not.
    px, py, pz = jnp.moveaxis(points, -1, 0)
    views = camera.viewmats[:, :3, :, None]
    x, y, z = (views[:, i, 0] * px + views[:, i, 1] * py + views[:, i, 2] * pz + views[:, i, 3] for i in range(3))
    in_front = (z > NEAR) & jnp.isfinite(z) & (weights > 0)
    inverse_z = 1.0 / jnp.where(in_front, z, 1.0)
    Ks = camera.Ks[:, :, :, None]
    u = Ks[:, 0, 0] * x * inverse_z + Ks[:, 0, 2]
    v = Ks[:, 1, 1] * y * inverse_z + Ks[:, 1, 2]
    is_seen = in_front & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    columns, rows = (jnp.where(is_seen, jnp.floor(c), 0.0).astype(jnp.int32) for c in (u, v))
    first_pixel = jnp.arange(len(camera.viewmats), dtype=jnp.int32)[:, None] * (camera.height * camera.width)
    num_pixels = len(camera.viewmats) * camera.height * camera.width
    return PixelPairs(
        pixels=jnp.where(is_seen, first_pixel + rows * camera.width + columns, num_pixels).reshape(-1),
        log_depths=jnp.where(is_seen, jnp.log(jnp.where(is_seen, z, 1.0)), 0.0).reshape(-1),
        weights=jnp.where(is_seen, weights, 0.0).reshape(-1),
    )
