"""VACC's read: the projection P of the cache into views (Eq. cache_projection).

Each pixel reads its front cluster in log depth. With ell = ln z, w = confidence and window = ln(cluster_ratio):

    pass 1   L0 = min ell                            over the pivots that fall on the pixel
    pass 2   mu = sum w ell / sum w                  over ell <= L0 + window
    pass 3   D, Omega, F from w-weighted sums        over |ell - mu| <= window     (re-centered once)

A plain mean would mix background into a fifth of the pixels. A window about the minimum alone would be biased towards
the camera, and the bias would feed back through the anchor into the cache. A pivot covers the one pixel that contains
its projected center.

Each pass visits the rows in sight (`pixel_pairs`). Features are read only for the pairs (view, pivot) in a cluster.
Sums run in row order, so on the CPU the result is the same to the last bit every time.
"""

import functools
import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ssplat_jax.cache.pixel_pairs import PixelPairs, fold_pairs, rows_in_sight
from ssplat_jax.cache.state import VoxelCache
from ssplat_jax.config import StreamConfig
from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.pytree import pytree

CLUSTER_RATIO = 1.15
"""Largest ratio of depths within the front cluster of a pixel. A mean over all its pivots mixes foreground and
background."""

PAIRS_PER_BLOCK = 4096
"""Most pairs whose features are gathered at a time."""


@pytree
class ProjectedCache:
    """The cache as seen from each view: zeros, and `mask` False, in pixels without a pivot."""

    depths: Float[Array, "v hf wf"]  # D_H, camera z
    confidences: Float[Array, "v hf wf"]  # Omega_H = sum w^2 / sum w
    feats: Float[Array, "v hf wf c"]  # F_H
    mask: Bool[Array, "v hf wf"]
    colors: Float[Array, "v hf wf 3"] | None  # averaged like F_H; None without `match_exposure`


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
    with jax.named_scope("project"):
        # Carved pivots must not occlude. Without carving no pivot is below tau: all were accepted at tau or more.
        min_confidence = config.memory.min_confidence if config.memory.carving else 0.0
        in_sight = rows_in_sight(cache, camera, min_confidence=min_confidence)
        fold = functools.partial(fold_pairs, cache, camera, in_sight, min_confidence=min_confidence)
        fronts = _reduce_shards(jax.lax.pmin, fold(_min_log_depths, jnp.full((math.prod(shape),), jnp.inf)), axis)
        centers = _front_means(fold, config, fronts, axis)
        sums = _cluster_sums(fold, cache, len(camera.viewmats), config, fronts, centers)
        weights, squares, offsets, values = _reduce_shards(jax.lax.psum, sums, axis)
    mask = weights > 0
    total = jnp.where(mask, weights, 1.0)
    means = (values / total[:, None]).reshape(*shape, -1)
    width = cache.feats.shape[-1]
    log_depths = jnp.where(mask, fronts, 0.0) + offsets / total
    return ProjectedCache(
        depths=jnp.where(mask, jnp.exp(log_depths), 0.0).reshape(shape),
        confidences=(squares / total).reshape(shape),
        feats=means[..., :width],
        mask=mask.reshape(shape),
        colors=means[..., width:] if config.stream.match_exposure else None,
    )


def coarsen(history: ProjectedCache, factor: int) -> ProjectedCache:
    """`history` on a grid coarser by `factor`: each coarse cell takes all values of its nearest fine cell.

    Cells are not averaged, since the mean of a front and a back surface lies on neither.

    Limits:
        A coarse cell without a filled fine cell is a hole.
    """
    if factor == 1:
        return history
    v, h, w = history.depths.shape

    def patches(x):
        x = x.reshape(v, h // factor, factor, w // factor, factor, -1).swapaxes(2, 3)
        return x.reshape(v, h // factor, w // factor, factor * factor, -1)

    nearest = jnp.argmin(patches(jnp.where(history.mask, history.depths, jnp.inf)), axis=3, keepdims=True)
    take = lambda x: jnp.take_along_axis(patches(x), nearest, axis=3)[..., 0, :]  # noqa: E731
    return ProjectedCache(
        depths=take(history.depths)[..., 0],
        confidences=take(history.confidences)[..., 0],
        feats=take(history.feats),
        mask=take(history.mask)[..., 0],
        colors=None if history.colors is None else take(history.colors),
    )


def _front_window(config: StreamConfig) -> float:
    """Span of a front cluster in log depth; without `front_cluster` all pivots of a pixel are averaged."""
    return math.log(CLUSTER_RATIO) if config.additions.front_cluster else math.inf


def _reduce_shards(reduce, partial, axis: str | None):
    """`partial` reduced over all shards; `partial` itself without an axis."""
    return partial if axis is None else reduce(partial, axis)


def _min_log_depths(fronts, pairs: PixelPairs, rows, is_row):
    """Pass 1: log depth of the nearest pivot in each pixel."""
    del rows, is_row
    return fronts.at[pairs.pixels].min(pairs.log_depths, mode="drop")


def _front_means(fold, config, fronts, axis):
    """Pass 2: mean log depth of each pixel's front window, relative to its nearest pivot."""
    window = _front_window(config)

    def visit(sums, pairs: PixelPairs, rows, is_row):
        del rows, is_row
        offsets = _offsets_from_front(pairs, fronts)
        weights = jnp.where(offsets <= window, pairs.weights, 0.0)
        return _scatter_add(sums, pairs.pixels, (weights, weights * offsets))

    sums = fold(visit, (jnp.zeros_like(fronts), jnp.zeros_like(fronts)))
    weights, offsets = _reduce_shards(jax.lax.psum, sums, axis)
    return offsets / jnp.where(weights > 0, weights, 1.0)


def _cluster_sums(fold, cache, num_views, config, fronts, centers):
    """Pass 3: sums over each pixel's re-centered cluster: w, w^2, w times offset from the front, w times values."""
    window = _front_window(config)
    pivots_per_row = cache.feats.shape[1]
    flat = lambda x: x.reshape(-1, x.shape[-1])  # noqa: E731

    def values_of(pivots):
        feats = flat(cache.feats)[pivots].astype(jnp.float32)
        if not config.stream.match_exposure:
            return feats
        colors = flat(cache.rgbs)[pivots].reshape(len(pivots), -1, 3).mean(axis=1)
        return jnp.concatenate([feats, colors], axis=1)

    num_values = jax.eval_shape(values_of, jnp.zeros(1, jnp.int32)).shape[1]

    def visit(state, pairs: PixelPairs, rows, is_row):
        del is_row
        scalars, sums = state
        offsets = _offsets_from_front(pairs, fronts)
        weights = jnp.where(jnp.abs(offsets - centers[pairs.pixels]) <= window, pairs.weights, 0.0)
        scalars = _scatter_add(scalars, pairs.pixels, (weights, weights * weights, weights * offsets))
        pivots = (rows[:, None] * pivots_per_row + jnp.arange(pivots_per_row)).reshape(-1)
        return scalars, _add_values(sums, values_of, pairs.pixels, weights, pivots, num_views)

    zeros = jnp.zeros_like(fronts)
    sums = jnp.zeros((fronts.shape[0], num_values))
    scalars, sums = fold(visit, ((zeros, zeros, zeros), sums))
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


def _offsets_from_front(pairs: PixelPairs, fronts):
    """Log depth relative to the pixel's nearest pivot; 0 for points not seen."""
    return jnp.where(pairs.weights > 0, pairs.log_depths - fronts[pairs.pixels], 0.0)


def _scatter_add(sums, pixels, values):
    return tuple(s.at[pixels].add(x, mode="drop") for s, x in zip(sums, values, strict=True))
