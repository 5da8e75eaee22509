"""Votes of depth maps: views lower the confidence of points they see through and raise that of surfaces they see.

This is an addition to the paper's VACC, which never forgets a wrong pivot: a floater of one view hides the scene from
every other view. A confidence is read as the probability that a surface is there. Every trusted cell that a pivot or a
token projects to votes on it, with the weight w of the cell's own confidence:

    sees through it    log depth before the cell's nearest surface by more than ln(1.02): odds / e^2w
    sees it            log depth within ln(1.1) of the cell's surface: odds x e^0.5w
    hidden or unseen   anything else: unchanged

One vote changes a confident pivot little; several take it below tau, where `decode` omits it. It stays in the cache and
can recover. The views of a chunk vote on all pivots (`carve`). A coarse copy of one of them is kept (`store_depths`)
and votes on the tokens of later chunks before they enter the cache (`vote`).
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ssplat_jax.cache.project import PixelPairs, fold_pairs, places_of, project_points, rows_in_sight, rows_of
from ssplat_jax.cache.state import StoredDepths, Tokens, VoxelCache
from ssplat_jax.config import StreamConfig
from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.numerics import safe_log
from ssplat_jax.core.pytree import replace

AGAINST_LOG_ODDS, FOR_LOG_ODDS = 2.0, 0.5
"""Log odds that a vote of weight 1 takes away or adds. Votes against weigh more: a wrong depth may agree with its
neighbors by chance, but nothing stands where a view looked through."""

FREE_SPACE_MARGIN = math.log(1.02)
"""A point nearer than a surface by more than this, in log depth, lies in the free space before it."""

SAME_SURFACE_MARGIN = math.log(1.1)
"""Two log depths at most this far apart belong to one surface."""

MIN_REVISED, MAX_REVISED = 0.02, 0.95
"""Bounds of revised confidences: inside them a later vote can still change a confidence either way."""


def carve(
    cache: VoxelCache,
    camera: Camera,
    depths: Float[Array, "v hf wf"],
    confidences: Float[Array, "v hf wf"],
    config: StreamConfig,
) -> VoxelCache:
    """`cache` with the confidences of its pivots revised by the votes of one chunk's views.

    Args:
        cache: the cache after the chunk was fused.
        camera: the chunk's views at grid resolution.
        depths: camera z of each cell, stream units.
        confidences: confidence of each depth; cells of 0 or below `min_confidence` do not vote.
        config: with `carving=False` the cache is returned unchanged.

    Returns:
        The cache; only `confidences` differs.

    Limits:
        Depths that are not finite or not positive do not vote. Pivots without a vote keep their confidence to the last
        bit; all others end in [0.02, 0.95].
    """
    if not config.memory.carving:
        return cache
    trusted = is_trusted(depths, confidences, config)
    log_depths = safe_log(jnp.where(trusted, depths, 1.0))
    # A cell beside an untrusted one cannot declare space free: a depth edge may run between them.
    window = (jnp.where(trusted, log_depths, -jnp.inf), jnp.inf, jax.lax.min, (1, 3, 3), (1, 1, 1), "SAME")
    nearest = jax.lax.reduce_window(*window)
    weights = jnp.where(trusted, confidences, 0.0)
    flat = (weights.reshape(-1), log_depths.reshape(-1), nearest.reshape(-1))

    def visit(revised, pairs: PixelPairs, rows, is_row):
        before = rows_of(cache.confidences, rows)
        votes = _votes(pairs, *flat).reshape(len(camera.viewmats), *before.shape).sum(axis=0)
        return revised.at[places_of(rows, is_row, cache)].set(_revise(before, votes), mode="drop")

    return replace(cache, confidences=fold_pairs(cache, camera, rows_in_sight(cache, camera), visit, cache.confidences))


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
    log_depths = stored.log_depths.reshape(-1)
    votes = _votes(pairs, stored.weights.reshape(-1), log_depths, log_depths)
    votes = votes.reshape(len(stored.viewmats), -1).sum(axis=0)
    return replace(tokens, confidences=_revise(tokens.confidences, votes))


def store_depths(
    cache: VoxelCache,
    camera: Camera,
    depths: Float[Array, "v hf wf"],
    confidences: Float[Array, "v hf wf"],
    config: StreamConfig,
) -> VoxelCache:
    """`cache` with a coarse copy of the chunk's view that has the most trusted cells (the first of equals).

    Args:
        cache: the cache after the chunk was fused.
        camera: the chunk's views at grid resolution.
        depths: camera z of each cell, stream units.
        confidences: confidence of each depth.
        config: decides which cells are trusted, as in `carve`.

    Returns:
        The cache; only `stored_depths` differs.

    Limits:
        A chunk without a trusted cell, such as padding, is not stored and displaces no other.
    """
    capacity, side = cache.stored_depths.weights.shape[:2]
    if not capacity:
        return cache
    trusted = is_trusted(depths, confidences, config)
    view = jnp.argmax(trusted.sum(axis=(1, 2)))
    seen = trusted[view]
    log_depths = _min_per_part(jnp.where(seen, safe_log(jnp.where(seen, depths[view], 1.0)), -jnp.inf), side)
    weights = _min_per_part(jnp.where(seen, confidences[view], 0.0), side)
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


def is_trusted(depths: Float[Array, "*s"], confidences: Float[Array, "*s"], config: StreamConfig) -> Bool[Array, "*s"]:
    """Cells whose depth counts: finite, positive, and of at least `min_confidence`."""
    return (confidences >= config.memory.min_confidence) & (confidences > 0) & jnp.isfinite(depths) & (depths > 0)


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
    """Log odds that each pair of view and point adds to the point's confidence."""
    read = lambda x: x.at[pairs.pixels].get(mode="fill", fill_value=0.0)  # noqa: E731
    is_free = pairs.log_depths < read(nearest) - FREE_SPACE_MARGIN
    is_seen = jnp.abs(pairs.log_depths - read(log_depths)) <= SAME_SURFACE_MARGIN
    return read(weights) * jnp.where(is_free, -AGAINST_LOG_ODDS, jnp.where(is_seen, FOR_LOG_ODDS, 0.0))


def _revise(confidences, votes):
    """Confidences after votes in log odds; unchanged where the votes add up to 0."""
    known = jnp.clip(confidences, MIN_REVISED, MAX_REVISED)
    revised = jax.nn.sigmoid(safe_log(known) - safe_log(1 - known) + votes)
    return jnp.where(votes != 0, jnp.clip(revised, MIN_REVISED, MAX_REVISED), confidences)
