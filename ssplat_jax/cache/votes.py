"""Views judge pivots: they vote on the confidence, and leave observations that the decoder reads.

Both are additions to the paper's VACC, which never forgets a wrong pivot: a floater of one view hides the scene from
every other view. A confidence is read as the probability that a surface is there. Every trusted cell that a pivot or a
token projects to votes on it, with the weight w of the cell's own confidence:

    sees through it    log depth before the cell's nearest surface by more than ln(1.02): odds / e^2w
    sees it            log depth within ln(1.1) of the cell's surface: odds x e^0.5w
    hidden or unseen   anything else: unchanged

One vote changes a confident pivot little; several take it below tau, where `decode` omits it. It stays in the cache and
can recover. The views of a chunk vote on all pivots (`carve`). A coarse copy of one of them is kept (`store_depths`)
and votes on the tokens of later chunks before they enter the cache (`vote`).

A feature that was written with its token does not know which pivots later views confirm. So `observe` sums up, over all
views since the pivot was written, how often it lay on the surface of a cell, before it or behind it, how far from it,
how well its color fitted, and how many other pivots shared the cell.
"""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ssplat_jax.cache.project import PixelPairs, RowsInSight, fold_pairs, project_points, rows_in_sight, rows_of
from ssplat_jax.cache.state import StoredDepths, Tokens, VoxelCache
from ssplat_jax.config import StreamConfig
from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.cpu_backend import kept
from ssplat_jax.core.numerics import safe_log
from ssplat_jax.core.pytree import pytree, replace

AGAINST_LOG_ODDS, FOR_LOG_ODDS = 2.0, 0.5
"""Log odds that a vote of weight 1 takes away or adds. Votes against weigh more: a wrong depth may agree with its
neighbors by chance, but nothing stands where a view looked through."""

FREE_SPACE_MARGIN = math.log(1.02)
"""A point nearer than a surface by more than this, in log depth, lies in the free space before it."""

SAME_SURFACE_MARGIN = math.log(1.1)  # two log depths at most this far apart belong to one surface
ON_SURFACE = math.log(1.03)  # largest distance in log depth at which an observed pivot lies on the surface of a cell

MIN_REVISED, MAX_REVISED = 0.02, 0.95
"""Bounds of revised confidences: inside them a later vote can still change a confidence either way."""

MOST_OBSERVED = 30.0
"""Total weight of observations up to which the decoder tells pivots apart: nine pivots of ten had less in the streams
that its evidence head learned from, and beyond it the head extrapolated."""


@pytree
class SeenCells:
    """Cells of a chunk's views. Trusted is one whose depth is finite, positive, and of at least `min_confidence`."""

    weights: Float[Array, "v hf wf"]  # confidence of the depth; 0 if it is not trusted
    log_depths: Float[Array, "v hf wf"]  # of camera z, stream units; 0 if it is not trusted
    colors: Float[Array, "c 3"]  # of all cells, view-major, row-major; at the exposure of the scene


def seen_cells(
    depths: Float[Array, "v hf wf"],
    confidences: Float[Array, "v hf wf"],
    rgbs: Float[Array, "m a"],
    config: StreamConfig,
) -> SeenCells:
    """Cells of a chunk whose tokens have the colors `rgbs`, view-major, row-major."""
    trusted = (confidences >= config.memory.min_confidence) & (confidences > 0) & jnp.isfinite(depths) & (depths > 0)
    return SeenCells(
        weights=jnp.where(trusted, confidences, 0.0),
        log_depths=safe_log(jnp.where(trusted, depths, 1.0)),
        colors=rgbs.reshape(len(rgbs), -1, 3).mean(axis=1),
    )


# Votes ----------------------------------------------------------------------------------------------------------------


def carve(
    cache: VoxelCache, camera: Camera, cells: SeenCells, config: StreamConfig, in_sight: RowsInSight | None = None
) -> VoxelCache:
    """`cache` with the confidences of its pivots revised by the votes of one chunk's views.

    Args:
        cache: the cache after the chunk was fused.
        camera: the chunk's views at grid resolution.
        cells: what they saw.
        config: with `carving=False` the cache is returned unchanged.
        in_sight: `rows_in_sight` of the cache and the views, for who has it already.

    Returns:
        The cache; only `confidences` differs.

    Limits:
        Pivots without a vote keep their confidence to the last bit; all others end in [0.02, 0.95].
    """
    if not config.memory.carving:
        return cache
    # A cell beside an untrusted one cannot declare space free: a depth edge may run between them.
    fronts = jnp.where(cells.weights > 0, cells.log_depths, -jnp.inf)
    nearest = jax.lax.reduce_window(fronts, jnp.inf, jax.lax.min, (1, 3, 3), (1, 1, 1), "SAME")

    def visit(revised, pairs: PixelPairs, rows, places):
        before = rows_of(cache.confidences, rows)
        votes = _votes(pairs, cells.weights, cells.log_depths, nearest)
        votes = votes.reshape(len(camera.viewmats), *before.shape).sum(axis=0)
        return revised.at[places].set(_revise(before, votes), mode="drop")

    in_sight = in_sight or rows_in_sight(cache, camera)
    return replace(cache, confidences=fold_pairs(cache, camera, in_sight, visit, cache.confidences))


def vote(stored: StoredDepths, tokens: Tokens, config: StreamConfig) -> Tokens:
    """`tokens` with their confidences revised by the votes of the stored depths of earlier chunks.

    Limits:
        Tokens that are invalid, not finite, below `min_confidence` or without a vote keep their confidence to the last
        bit; all others end in [0.02, 0.95].
    """
    if not stored.weights.shape[0]:
        return tokens
    side = stored.weights.shape[-1]
    camera = Camera(viewmats=stored.viewmats, Ks=stored.Ks, width=side, height=side)
    is_voted_on = tokens.valid & (tokens.confidences >= config.memory.min_confidence)
    pairs = project_points(tokens.means, jnp.where(is_voted_on, tokens.confidences, 0.0), camera)
    votes = _votes(pairs, stored.weights, stored.log_depths, stored.log_depths)
    votes = votes.reshape(len(stored.viewmats), -1).sum(axis=0)
    return replace(tokens, confidences=_revise(tokens.confidences, votes))


def store_depths(cache: VoxelCache, camera: Camera, cells: SeenCells) -> VoxelCache:
    """`cache` with a coarse copy of the chunk's view that has the most trusted cells (the first of equals).

    The arguments are those of `carve`; only `stored_depths` of the cache differs.

    Limits:
        A chunk without a trusted cell, such as padding, is not stored and displaces no other.
    """
    capacity, side = cache.stored_depths.weights.shape[:2]
    if not capacity:
        return cache
    trusted = cells.weights > 0
    view = jnp.argmax(trusted.sum(axis=(1, 2)))
    seen = trusted[view]
    log_depths = _min_per_part(jnp.where(seen, cells.log_depths[view], -jnp.inf), side)
    weights = _min_per_part(cells.weights[view], side)
    shrink = jnp.array([side / camera.width, side / camera.height, 1.0], camera.Ks.dtype)[:, None]
    entry = StoredDepths(
        viewmats=camera.viewmats[view][None],
        Ks=(camera.Ks[view] * shrink)[None],
        log_depths=jnp.where(weights > 0, log_depths, 0.0)[None],
        weights=weights[None],
    )
    place = jnp.where(seen.any(), (cache.stats.num_chunks - 1) % capacity, capacity)[None]
    stored = jax.tree.map(lambda ring, x: ring.at[place].set(x, mode="drop"), cache.stored_depths, entry)
    return replace(cache, stored_depths=stored)


def _min_per_part(values: Float[Array, "hf wf"], side: int) -> Float[Array, "side side"]:
    """Minimum over the cells that each of `side` x `side` equal parts of the view touches."""
    parts = np.arange(side)
    for axis in (0, 1):
        num_cells = values.shape[axis]
        first, last = parts * num_cells // side, -(-(parts + 1) * num_cells // side) - 1
        touched = np.minimum(first[:, None] + np.arange((last - first).max() + 1), last[:, None])
        values = jnp.take(values, touched, axis=axis).min(axis=axis + 1)
    return values


def _votes(pairs: PixelPairs, weights, log_depths, nearest) -> Float[Array, " p"]:
    """Log odds that each pair of view and point adds to the point's confidence, from maps of all views."""
    read = lambda x: x.reshape(-1).at[pairs.pixels].get(mode="fill", fill_value=0.0)  # noqa: E731
    is_free = pairs.log_depths < read(nearest) - FREE_SPACE_MARGIN
    is_seen = jnp.abs(pairs.log_depths - read(log_depths)) <= SAME_SURFACE_MARGIN
    return read(weights) * jnp.where(is_free, -AGAINST_LOG_ODDS, jnp.where(is_seen, FOR_LOG_ODDS, 0.0))


def _revise(confidences, votes):
    """Confidences after votes in log odds; unchanged where the votes add up to 0."""
    known = jnp.clip(confidences, MIN_REVISED, MAX_REVISED)
    revised = jax.nn.sigmoid(safe_log(known) - safe_log(1 - known) + votes)
    return jnp.where(votes != 0, jnp.clip(revised, MIN_REVISED, MAX_REVISED), confidences)


# Observations ---------------------------------------------------------------------------------------------------------


def observe(
    cache: VoxelCache,
    camera: Camera,
    cells: SeenCells,
    config: StreamConfig,
    in_sight: RowsInSight | None = None,
    *,
    axis: str | None = None,
) -> VoxelCache:
    """`cache` with what the views of one chunk say about its pivots added to their observations.

    Args:
        cache: the cache after the chunk was fused; it keeps observations.
        camera: the chunk's views at grid resolution.
        cells: what they saw.
        config: pivots below its `min_confidence` do not count as others in a cell.
        in_sight: as in `carve`, which changes nothing of it.
        axis: name of the mapped axis over which the cache is sharded by voxel; None if `cache` is the whole cache.

    Returns:
        The cache; only `observations` differs.

    Limits:
        Pivots that no trusted cell sees keep their observations to the last bit.
    """
    num_cells, in_sight = cells.weights.size, in_sight or rows_in_sight(cache, camera)
    read = functools.partial(_read_cells, cache, camera, cells)

    def crowd(sums, pairs: PixelPairs, rows, places):
        seen = read(pairs, rows)
        on = jnp.where(pairs.weights >= config.memory.min_confidence, seen.on.reshape(-1), 0.0)
        return sums.at[pairs.pixels].add(jnp.stack([on, on * seen.errors.reshape(-1)], axis=-1), mode="drop")

    sums = fold_pairs(cache, camera, in_sight, crowd, jnp.zeros((num_cells, 2)))
    others, errors = (sums if axis is None else jax.lax.psum(sums, axis)).T
    others = jnp.maximum(others, 1.0)
    table = jnp.stack([jnp.log(others), errors / others], axis=-1)

    def add(observations, pairs: PixelPairs, rows, places):
        seen = read(pairs, rows)
        others = table.at[pairs.pixels].get(mode="fill", fill_value=0.0).reshape(*seen.weights.shape, 2)
        others = kept(others, cache.num_voxels >= 0)
        on = seen.weights * seen.on
        before = jnp.where(seen.offsets < -1, seen.weights, 0.0)
        sums = (
            on,
            before,
            jnp.where(seen.offsets > 1, seen.weights, 0.0),
            on * seen.errors,
            before * seen.errors,
            on * seen.offsets,
            on * others[..., 0],
            on * (seen.errors - others[..., 1]),
            on * seen.sizes,
        )
        new = jnp.stack([x.sum(axis=0) for x in sums], axis=-1).reshape(len(rows), *observations.shape[1:])
        return observations.at[places].add(new, mode="drop")

    return replace(cache, observations=fold_pairs(cache, camera, in_sight, add, cache.observations))


@pytree
class _Pairs:
    """Pairs of view and pivot of a block of rows, `[v, n]`."""

    weights: Float[Array, "v n"]  # of the cell
    offsets: Float[Array, "v n"]  # log depth of the pivot less the cell's, in units of `ON_SURFACE`
    on: Float[Array, "v n"]  # 1 where the pivot lies on the surface of a trusted cell, else 0
    errors: Float[Array, "v n"]  # mean absolute difference of the colors
    sizes: Float[Array, "v n"]  # log of the pivot's footprint over the cell's


def _read_cells(cache: VoxelCache, camera: Camera, cells: SeenCells, pairs: PixelPairs, rows: Int[Array, " n"]):
    """Contents of the cells into which `pairs` fall, compared with the pivots of `rows`; zeros for pivots not seen."""
    num_views, always = len(camera.viewmats), cache.num_voxels >= 0
    flat = lambda x: rows_of(x, rows).reshape(-1, *x.shape[2:])  # noqa: E731
    table = jnp.concatenate([cells.weights.reshape(-1, 1), cells.log_depths.reshape(-1, 1), cells.colors], axis=1)
    held = table.at[pairs.pixels].get(mode="fill", fill_value=0.0)
    held, log_depths = kept((held.reshape(num_views, -1, 5), pairs.log_depths.reshape(num_views, -1)), always)
    rgbs = flat(cache.rgbs)
    colors = kept(rgbs.reshape(len(rgbs), -1, 3).mean(axis=1), always)
    weights = held[..., 0]
    keep = lambda x: jnp.where(weights > 0, x, 0.0)  # noqa: E731
    offsets = keep((log_depths - held[..., 1]) / ON_SURFACE)
    return _Pairs(
        weights=weights,
        offsets=offsets,
        on=jnp.where((weights > 0) & (jnp.abs(offsets) <= 1), 1.0, 0.0),
        errors=keep(jnp.abs(held[..., 2:] - colors).mean(axis=-1)),
        sizes=keep(safe_log(flat(cache.footprints)) - log_depths + jnp.log(camera.Ks[:, 0, 0])[:, None]),
    )


def total_weight(observations: Float[Array, "*n s"]) -> Float[Array, "*n"]:
    """Weight of all cells that told something about a pivot: it grows whenever its observations change."""
    return observations[..., :3].sum(axis=-1)


def observation_features(observations: Float[Array, "n s"]) -> Float[Array, "n f"]:
    """Observations as numbers of about unit size: logarithms of the counts, shares, and means.

    Limits:
        Zeros, as for a pivot that no trusted cell has seen, give finite features. No gradient flows to observations.
        Above a total weight of `MOST_OBSERVED` the counts grow no further; shares and means stay those of all views.
    """
    most = MOST_OBSERVED / jnp.maximum(total_weight(observations), MOST_OBSERVED)
    observations = jax.lax.stop_gradient(observations * most[..., None])
    on, before, behind, error_on, error_before, offset, crowd, relative, size = jnp.moveaxis(observations, -1, 0)
    total, times_on = jnp.maximum(on + before + behind, 1e-3), jnp.maximum(on, 1e-3)
    error = (error_on + error_before) / jnp.maximum(on + before, 1e-3)
    features = (
        jnp.log1p(on) - 1.5,
        jnp.log1p(before) - 0.5,
        jnp.log1p(behind) - 0.5,
        4 * (before / total - 0.15),
        4 * (behind / total - 0.15),
        safe_log(0.01 + error_on / times_on) + 3.0,
        safe_log(0.01 + error) + 3.0,
        3 * offset / times_on,
        crowd / times_on - 1.0,
        20 * relative / times_on,
        size / times_on,
    )
    return jnp.stack(features, axis=-1)
