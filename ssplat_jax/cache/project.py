"""VACC's read: the projection P of the cache into views (Eq. cache_projection).

Each pixel reads its front cluster in log depth. With ell = ln z, w = confidence and window = ln(CLUSTER_RATIO):

    pass 1   L0 = min ell                            over the pivots that fall on the pixel
    pass 2   mu = sum w ell / sum w                  over ell <= L0 + window
    pass 3   D, Omega, F from w-weighted sums        over |ell - mu| <= window     (re-centered once)

A plain mean would mix background into a fifth of the pixels. A window about the minimum alone would be biased towards
the camera, and the bias would feed back through the anchor into the cache. A pivot covers the one pixel that contains
its projected center.

The passes, and the votes and observations of views, fold over pairs of a view and a pivot. A view sees a small part of
a large scene, so the rows that some view sees are listed first, and only they are read again: all but the listing takes
time in proportion to the pivots in sight. Sums run in row order, so on the CPU they are the same to the last bit.
"""

import functools
import math
from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ssplat_jax.cache.state import VoxelCache
from ssplat_jax.config import StreamConfig
from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.numerics import columns
from ssplat_jax.core.pytree import pytree

NEAR = 0.01  # near plane: pivots at or before this camera z (stream units) are invisible, as in the renderer
CLUSTER_RATIO = 1.15  # largest ratio of depths within the front cluster of a pixel

ROWS_PER_BLOCK, PAIRS_PER_BLOCK = 4096, 4096
"""Most cache rows that are projected at a time, and most pairs whose features are gathered at a time."""

State = TypeVar("State")


@pytree
class ProjectedCache:
    """The cache as seen from each view: zeros, and `mask` False, in pixels without a pivot."""

    depths: Float[Array, "v hf wf"]  # D_H, camera z
    confidences: Float[Array, "v hf wf"]  # Omega_H = sum w^2 / sum w
    feats: Float[Array, "v hf wf c"] | None  # F_H; None without `cgfi`, which alone reads it
    mask: Bool[Array, "v hf wf"]
    colors: Float[Array, "v hf wf 3"] | None  # averaged like F_H; None where nothing reads them, see `_has_colors`


def project(cache: VoxelCache, camera: Camera, config: StreamConfig, *, axis: str | None = None) -> ProjectedCache:
    """Depth, confidence and features of `cache` in the pixels of `camera`.

    Args:
        cache: what is projected.
        camera: a batch of views at grid resolution.
        config: `front_cluster`; `carving` leaves out the pivots below `min_confidence`.
        axis: name of the mapped axis over which the cache is sharded by voxel; None if `cache` is the whole cache.

    Returns:
        The projection of the whole cache, on every shard; no gradient flows to the cache or the cameras.

    Limits:
        Pivots with camera z <= 0.01, confidence 0 (with `carving`, below `min_confidence`) or a center outside the
        image are not seen.
        An empty cache, and a pixel without a pivot, give zeros and a False mask.
        Over an axis the sums run in another order than over one cache: results agree to float32 rounding.
    """
    cache, camera = jax.lax.stop_gradient((cache, camera))
    shape = (camera.viewmats.shape[0], camera.height, camera.width)
    window = math.log(CLUSTER_RATIO) if config.additions.front_cluster else math.inf
    over_shards = lambda reduce, x: x if axis is None else reduce(x, axis)  # noqa: E731
    with jax.named_scope("project"):
        # Carved pivots must not occlude: in front of a good surface they would be all that HPDA and CGFI see. Without
        # carving no pivot is below tau: all were accepted at tau or more.
        min_confidence = config.memory.min_confidence if config.memory.carving else 0.0
        in_sight = rows_in_sight(cache, camera, min_confidence=min_confidence)
        fold = functools.partial(fold_pairs, cache, camera, in_sight, min_confidence=min_confidence)
        start = jnp.full((math.prod(shape),), jnp.inf)
        nearest = lambda x, pairs, rows, places: x.at[pairs.pixels].min(pairs.log_depths, mode="drop")  # noqa: E731
        fronts = over_shards(jax.lax.pmin, fold(nearest, start))
        weights, offsets = over_shards(jax.lax.psum, _front_sums(fold, window, fronts))
        centers = offsets / jnp.where(weights > 0, weights, 1.0)
        sums = _cluster_sums(fold, window, cache, len(camera.viewmats), config, fronts, centers)
        weights, squares, offsets, values = over_shards(jax.lax.psum, sums)
    mask = weights > 0
    total = jnp.where(mask, weights, 1.0)
    means = (values / total[:, None]).reshape(*shape, -1)
    width = cache.feats.shape[-1] if config.history.cgfi else 0
    log_depths = jnp.where(mask, fronts, 0.0) + offsets / total
    return ProjectedCache(
        depths=jnp.where(mask, jnp.exp(log_depths), 0.0).reshape(shape),
        confidences=(squares / total).reshape(shape),
        feats=means[..., :width] if config.history.cgfi else None,
        mask=mask.reshape(shape),
        colors=means[..., width:] if _has_colors(config) else None,
    )


def _has_colors(config: StreamConfig) -> bool:
    """True if exposures are matched or the learned anchor compares colors."""
    return config.stream.match_exposure or (config.is_anchored and config.additions.anchor == "learned")


def coarsen(history: ProjectedCache, factor: int) -> ProjectedCache:
    """`history` on a grid coarser by `factor`: each coarse cell takes all values of its nearest fine cell.

    Limits:
        A coarse cell without a filled fine cell is a hole.
    """
    if factor == 1:
        return history
    v, h, w = history.depths.shape

    def patches(x):
        x = x.reshape(v, h // factor, factor, w // factor, factor, -1).swapaxes(2, 3)
        return x.reshape(v, h // factor, w // factor, factor * factor, -1)

    # Cells are not averaged, since the mean of a front and a back surface lies on neither.
    nearest = jnp.argmin(patches(jnp.where(history.mask, history.depths, jnp.inf)), axis=3, keepdims=True)
    take = lambda x: jnp.take_along_axis(patches(x), nearest, axis=3).reshape(v, h // factor, w // factor, *x.shape[3:])  # noqa: E731
    return jax.tree.map(take, history)


def _front_sums(fold, window, fronts):
    """Pass 2: sums over each pixel's front window: w, and w times log depth relative to its nearest pivot."""

    def visit(sums, pairs: PixelPairs, rows, places):
        offsets = _offsets_from_front(pairs, fronts)
        weights = jnp.where(offsets <= window, pairs.weights, 0.0)
        return _scatter_add(sums, pairs.pixels, (weights, weights * offsets))

    return fold(visit, (jnp.zeros_like(fronts), jnp.zeros_like(fronts)))


def _cluster_sums(fold, window, cache, num_views, config, fronts, centers):
    """Pass 3: sums over each pixel's re-centered cluster: w, w^2, w times offset from the front, w times values."""
    pivots_per_row = cache.feats.shape[1]
    flat = lambda x: x.reshape(-1, x.shape[-1])  # noqa: E731

    def values_of(pivots):
        values = [jnp.zeros((len(pivots), 0))]
        if config.history.cgfi:
            values.append(flat(cache.feats)[pivots].astype(jnp.float32))
        if _has_colors(config):
            values.append(flat(cache.rgbs)[pivots].reshape(len(pivots), -1, 3).mean(axis=1))
        return jnp.concatenate(values, axis=1)

    def visit(state, pairs: PixelPairs, rows, places):
        scalars, sums = state
        offsets = _offsets_from_front(pairs, fronts)
        weights = jnp.where(jnp.abs(offsets - centers[pairs.pixels]) <= window, pairs.weights, 0.0)
        scalars = _scatter_add(scalars, pairs.pixels, (weights, weights * weights, weights * offsets))
        if not num_values:
            return scalars, sums
        pivots = (rows[:, None] * pivots_per_row + jnp.arange(pivots_per_row)).reshape(-1)
        return scalars, _add_values(sums, values_of, pairs.pixels, weights, pivots, num_views)

    zeros = jnp.zeros_like(fronts)
    num_values = jax.eval_shape(values_of, jnp.zeros(1, jnp.int32)).shape[1]
    scalars, sums = fold(visit, ((zeros, zeros, zeros), jnp.zeros((fronts.shape[0], num_values))))
    return *scalars, sums


def _add_values(sums, values_of, pixels, weights, pivots, num_views):
    """Adds w times value for the pairs of nonzero weight, which are compacted first: they are few."""
    num_pairs = pixels.shape[0]
    block = min(num_pairs, PAIRS_PER_BLOCK)
    has_weight = weights > 0
    places = jnp.where(has_weight, jnp.cumsum(has_weight) - 1, num_pairs)
    # Padded to a multiple of the block, because dynamic_slice shifts a slice that would pass the end.
    listed = jnp.full((num_pairs + -num_pairs % block,), num_pairs, jnp.int32)
    listed = listed.at[places].set(jnp.arange(num_pairs, dtype=jnp.int32), mode="drop")

    def add_block(i, sums):
        pairs = jax.lax.dynamic_slice(listed, (i * block,), (block,))
        is_pair = pairs < num_pairs
        pairs = jnp.minimum(pairs, num_pairs - 1)
        values = values_of(pivots[pairs % (num_pairs // num_views)]) * weights[pairs][:, None]
        return sums.at[jnp.where(is_pair, pixels[pairs], sums.shape[0])].add(values, mode="drop")

    num_blocks = (jnp.sum(has_weight, dtype=jnp.int32) + block - 1) // block
    return jax.lax.fori_loop(0, num_blocks, add_block, sums)


def _offsets_from_front(pairs, fronts):
    """Log depth relative to the pixel's nearest pivot; 0 for points not seen."""
    return jnp.where(pairs.weights > 0, pairs.log_depths - fronts[pairs.pixels], 0.0)


def _scatter_add(sums, pixels, values):
    return tuple(s.at[pixels].add(x, mode="drop") for s, x in zip(sums, values, strict=True))


# Pairs of a view and a pivot ------------------------------------------------------------------------------------------


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
    block = math.gcd(cache.capacity, ROWS_PER_BLOCK)

    def mark(i, marks):
        pivots = (cache.means, cache.confidences, cache.counts)
        means, confidences, counts = (jax.lax.dynamic_slice_in_dim(x, i * block, block) for x in pivots)
        pairs = _pairs(means, confidences, counts, camera, min_confidence)
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
    visit: Callable[[State, PixelPairs, Int[Array, " n"], Int[Array, " n"]], State],
    start: State,
    *,
    min_confidence: float = 0.0,
) -> State:
    """Folds `visit(state, pairs, rows, places)` over blocks of the rows in sight.

    Args:
        cache: holds the pivots.
        camera: a batch of views.
        in_sight: the rows that are visited, of the same cache and views.
        visit: takes the state, the `v * n * k` pairs of a block of n rows, view-major, the numbers of the rows, and the
            same as targets of a scatter: the last block is filled up with row 0, whose pairs are then not seen, and
            whose place a scatter drops.
        start: the state before the first block.
        min_confidence: pivots below it are not seen.
    """
    block = math.gcd(cache.capacity, ROWS_PER_BLOCK)

    def step(i, state):
        rows = jax.lax.dynamic_slice_in_dim(in_sight.rows, i * block, block)
        is_row = i * block + jnp.arange(block, dtype=jnp.int32) < in_sight.number
        means, confidences, counts = (rows_of(x, rows) for x in (cache.means, cache.confidences, cache.counts))
        pairs = _pairs(means, confidences, jnp.where(is_row, counts, 0), camera, min_confidence)
        return visit(state, pairs, rows, jnp.where(is_row, rows, cache.capacity))

    return jax.lax.fori_loop(0, (in_sight.number + block - 1) // block, step, start)


def rows_of(x: Array, rows: Int[Array, " n"]) -> Array:
    """`x[rows]` for row numbers that are valid."""
    return x.at[rows].get(mode="promise_in_bounds")


def _pairs(means, confidences, counts, camera: Camera, min_confidence: float) -> PixelPairs:
    """Pairs of all views with the pivots of some rows: `means` [n k 3], `confidences` [n k], `counts` [n]."""
    is_visible = (jnp.arange(means.shape[1]) < counts[:, None]) & (confidences >= min_confidence)
    return project_points(means.reshape(-1, 3), jnp.where(is_visible, confidences, 0.0).reshape(-1), camera)


def project_points(points: Float[Array, "n 3"], weights: Float[Array, " n"], camera: Camera) -> PixelPairs:
    """Pairs of all views with `points`, view-major; points of weight 0 or NaN are not seen."""
    # Written out per coordinate: three rows of products vectorize over the points, a 3 x 3 matrix product does not.
    px, py, pz = columns(points)
    right, down, forward, shift = columns(camera.viewmats[:, :3])
    turned = right[..., None] * px + down[..., None] * py + forward[..., None] * pz
    x, y, z = (c[:, 0] for c in jnp.split(turned + shift[..., None], 3, axis=1))
    in_front = (z > NEAR) & jnp.isfinite(z) & (weights > 0)
    inverse_z = 1.0 / jnp.where(in_front, z, 1.0)
    Ks = camera.Ks[:, :, :, None]
    u = Ks[:, 0, 0] * x * inverse_z + Ks[:, 0, 2]
    v = Ks[:, 1, 1] * y * inverse_z + Ks[:, 1, 2]
    is_seen = in_front & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    column, row = (jnp.where(is_seen, jnp.floor(c), 0.0).astype(jnp.int32) for c in (u, v))
    first_pixel = jnp.arange(len(camera.viewmats), dtype=jnp.int32)[:, None] * (camera.height * camera.width)
    num_pixels = len(camera.viewmats) * camera.height * camera.width
    return PixelPairs(
        pixels=jnp.where(is_seen, first_pixel + row * camera.width + column, num_pixels).reshape(-1),
        log_depths=jnp.where(is_seen, jnp.log(jnp.where(is_seen, z, 1.0)), 0.0).reshape(-1),
        weights=jnp.where(is_seen, weights, 0.0).reshape(-1),
    )
