"""VACC's write: fuses tokens into voxels (Sec. 3.4, Eq. vacc_capacity_update, vacc_pair_selection_and_merge).

The result equals inserting the tokens one after another, as the loop in tests/cache/numpy_reference.py does. Voxels do
not depend on each other, so all of them advance in parallel:

    tokens ─ classify ─ group by voxel ─ rows (found, or new in order of first token)
                                           │
              rank in voxel + count < K ───┤── append: all at once, one scatter
                                           └── merge: round r takes the r-th merging token of every voxel that has one

Voxels are sorted by the number of tokens they have to merge, so each round works on a prefix of them, and the prefixes
shrink. Neither time nor working memory grows with the capacity or the occupancy. Donated buffers are updated in place.
"""

import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, Integer, UInt32

from ssplat_jax.cache.hash_table import find_rows, group_equal, insert_rows, shards_of, voxel_indices
from ssplat_jax.cache.state import PIVOT_FIELDS, CacheStats, Tokens, VoxelCache, pivot_fields
from ssplat_jax.config import StreamConfig
from ssplat_jax.core.pytree import pytree, replace

MERGE_BLOCKS = ((512, 64), (16, 1))
"""Pairs (block size, least number of voxels in a round for which it pays)."""

SAME_DIRECTION = 1.0 - 1e-6
"""Signed squared cosines above this are ties: if a frame is given twice, rounding must not choose the pair."""

Fields = dict[str, Array]
"""Fields of pivots by name, of a whole cache `[capacity * k, ...]`, row by row, or of a list of pivots."""


@pytree
class Plan:
    """The place of every token."""

    rows: Int[Array, " m"]  # -1 for tokens left out
    slots: Int[Array, " m"]  # number of pivots and tokens before it in its row; from K on the token merges
    leaders: Int[Array, " m"]  # the first token of the same row; used for merging only
    order: Int[Array, " m"]  # tokens sorted by row, in order of arrival within a row; used for merging only


def fuse(cache: VoxelCache, tokens: Tokens, config: StreamConfig, *, axis: str | None = None) -> VoxelCache:
    """`cache` after inserting `tokens` in order.

    A voxel with a free slot stores the token as a new pivot. A full voxel merges the closest pair among its pivots and
    the token: the merged pivot keeps the lower slot and, if both were old pivots, the token takes the freed one. Tokens
    that are not finite, below `min_confidence`, out of range or without a free row are left out and counted in `stats`.

    Args:
        cache: the whole cache, or one shard of it.
        tokens: all tokens of a chunk, on every shard.
        config: sizes, thresholds and the variant of VACC.
        axis: name of the mapped axis over which the cache is sharded by voxel; None if `cache` is the whole cache. A
            voxel lies in one shard (`shards_of`), which alone inserts and counts its tokens.

    Returns:
        The cache; no gradient flows through it. The counters of the shards add up to those of a whole cache, except
        `num_chunks`, which every shard counts.

    Limits:
        A new pivot has changes of 0; those of merged pivots are averaged with the weights of their means.
        A new pivot has observations of 0; those of merged pivots add up.
        Feature norms in [1e-9, 1e9]: outside, and for zero features, a pair counts as orthogonal.
        Two members of confidence 0 are averaged with equal weights.
        A merged mean lies between its members, bit for bit, so it stays in their voxel.
    """
    cache, tokens = jax.lax.stop_gradient((cache, tokens))
    is_chunk = jnp.any(tokens.valid)
    voxels, in_range = voxel_indices(tokens.means, tokens.footprints, config)
    if axis is not None:
        # Rejected tokens have a voxel too (index 0 if out of range), so each is counted by one shard.
        is_own = shards_of(voxels, jax.lax.axis_size(axis)) == jax.lax.axis_index(axis)
        tokens = replace(tokens, valid=tokens.valid & is_own)
    accepted, stats = _classify(cache.stats, tokens, in_range, config)
    place = {"voxel": _place_in_voxels, "append": _place_at_end}[config.memory.vacc]
    cache, plan = place(cache, voxels, accepted, config)
    k, pivots = config.memory.pivots_per_voxel, {name: getattr(cache, name) for name in pivot_fields(cache)}
    pivots = {name: x.reshape(-1, *x.shape[2:]) for name, x in pivots.items()}
    new = _new_pivots(tokens, cache)
    appends = jnp.where(plan.slots < k, plan.rows, -1)
    counts = cache.counts.at[_unsigned(appends)].max(plan.slots + 1, mode="drop")
    pivots = _write(pivots, jnp.where(appends < 0, -1, appends * k + plan.slots), new)
    if config.memory.vacc == "voxel":
        pivots = _merge_all(pivots, new, plan, config)
    num_placed = jnp.sum(plan.rows >= 0, dtype=jnp.int32)
    stats = replace(
        stats,
        num_chunks=stats.num_chunks + is_chunk.astype(jnp.int32),
        num_accepted=saturating_add(stats.num_accepted, num_placed),
        num_merged=saturating_add(stats.num_merged, num_placed - jnp.sum(appends >= 0, dtype=jnp.int32)),
        num_dropped=saturating_add(stats.num_dropped, jnp.sum(accepted, dtype=jnp.int32) - num_placed),
    )
    pivots = {name: x.reshape(cache.capacity, k, *x.shape[1:]) for name, x in pivots.items()}
    return replace(cache, counts=counts, stats=stats, **pivots)


def saturating_add(counter: Int[Array, ""], more: Int[Array, ""]) -> Int[Array, ""]:
    """`counter + more` for numbers that are not negative; stops at the largest integer instead of overflowing."""
    return counter + jnp.minimum(more, jnp.iinfo(counter.dtype).max - counter)


def _classify(stats: CacheStats, tokens: Tokens, in_range, config: StreamConfig):
    """The mask of accepted tokens, and the counters with each rejected one under one reason."""
    finite = jnp.isfinite(tokens.confidences) & jnp.isfinite(tokens.footprints) & (tokens.footprints > 0)
    for x in (tokens.means, tokens.feats, tokens.rgbs, tokens.quats):
        finite &= jnp.all(jnp.isfinite(x), axis=-1)
    confident = tokens.confidences >= config.memory.min_confidence
    count = lambda mask: jnp.sum(tokens.valid & mask, dtype=jnp.int32)  # noqa: E731
    stats = replace(
        stats,
        num_seen=saturating_add(stats.num_seen, count(tokens.valid)),
        num_non_finite=saturating_add(stats.num_non_finite, count(~finite)),
        num_low_confidence=saturating_add(stats.num_low_confidence, count(finite & ~confident)),
        num_out_of_range=saturating_add(stats.num_out_of_range, count(finite & confident & ~in_range)),
    )
    return tokens.valid & finite & confident & in_range, stats


def _place_in_voxels(cache, voxels, accepted, config) -> tuple[VoxelCache, Plan]:
    """Finds or creates the row of every token's voxel; new rows go to voxels in order of their first tokens."""
    tokens = jnp.arange(accepted.shape[0], dtype=jnp.int32)
    leaders = group_equal(voxels, accepted)
    is_leader = accepted & (leaders == tokens)
    rows = find_rows(cache.table, cache.voxels, voxels, is_leader)
    is_new = is_leader & (rows < 0)
    new_rows = cache.num_voxels + jnp.cumsum(is_new, dtype=jnp.int32) - 1
    has_row = is_new & (new_rows < cache.capacity)  # a full cache drops the others
    cache = replace(
        cache,
        voxels=cache.voxels.at[jnp.where(has_row, new_rows, cache.capacity)].set(voxels, mode="drop"),
        num_voxels=jnp.minimum(cache.num_voxels + jnp.sum(is_new, dtype=jnp.int32), cache.capacity),
        table=insert_rows(cache.table, voxels, new_rows, has_row),
    )
    rows = jnp.where(accepted, jnp.where(has_row, new_rows, rows)[leaders], -1)
    order = _stable_order(jnp.where(accepted, leaders, tokens.shape[0]))
    ranks = tokens - jax.lax.cummax(jnp.where(is_leader[order], tokens, 0))
    ranks = jnp.zeros_like(ranks).at[order].set(ranks, unique_indices=True)
    return cache, Plan(rows=rows, slots=cache.counts[rows] + ranks, leaders=leaders, order=order)


def _stable_order(keys: Int[Array, " m"]) -> Int[Array, " m"]:
    """Stable argsort of `m` keys in 0 .. m."""
    m = keys.shape[0]
    indices = jnp.arange(m, dtype=jnp.uint32)
    if (m + 1) * m <= 2**32:
        # Key and index share one word: XLA's CPU backend sorts one array 6 times as fast as a pair.
        return (jnp.sort(keys.astype(jnp.uint32) * m + indices) % m).astype(jnp.int32)
    return jax.lax.sort((keys, indices.astype(jnp.int32)), num_keys=2, is_stable=False)[1]


def _place_at_end(cache, voxels, accepted, config) -> tuple[VoxelCache, Plan]:
    """The ablation `vacc="append"`: tokens fill the rows one slot after another, whatever their voxel."""
    k = config.memory.pivots_per_voxel
    last = jnp.maximum(cache.num_voxels - 1, 0)
    num_pivots = last * k + cache.counts[last]
    flat = num_pivots + jnp.cumsum(accepted, dtype=jnp.int32) - 1
    rows, slots = jnp.where(accepted & (flat < cache.capacity * k), flat // k, -1), flat % k
    num_voxels = jnp.maximum(cache.num_voxels, jnp.max(rows, initial=-1) + 1)
    tokens = jnp.arange(accepted.shape[0], dtype=jnp.int32)
    plan = Plan(rows=rows, slots=slots, leaders=tokens, order=tokens)  # nothing merges
    return replace(cache, num_voxels=num_voxels), plan


def _new_pivots(tokens: Tokens, cache: VoxelCache) -> Fields:
    """Every token as a pivot of its own, in the precision of the cache."""
    m = tokens.means.shape[0]
    values = {name: getattr(tokens, name) for name in PIVOT_FIELDS if hasattr(tokens, name)} | {
        "seeds": tokens.feats,
        "num_members": jnp.ones((m,), jnp.int32),
        "last_chunks": jnp.broadcast_to(cache.stats.num_chunks, (m,)),
    }
    for name in set(pivot_fields(cache)) - set(values):  # nothing observed or changed yet
        values[name] = jnp.zeros((m, getattr(cache, name).shape[-1]))
    return {name: values[name].astype(getattr(cache, name).dtype) for name in pivot_fields(cache)}


def _merge_all(pivots: Fields, new: Fields, plan: Plan, config: StreamConfig) -> Fields:
    """Merges tokens beyond K: round r takes each voxel's r-th such token, voxels with most of them first."""
    m, k = plan.order.shape[0], config.memory.pivots_per_voxel
    is_surplus = (plan.rows >= 0) & (plan.slots >= k)
    sizes = jnp.zeros((m,), jnp.int32).at[jnp.where(is_surplus, plan.leaders, m)].add(1, mode="drop")
    places = jnp.zeros((m,), jnp.int32).at[plan.order].set(jnp.arange(m, dtype=jnp.int32), unique_indices=True)
    starts = places + jnp.maximum(k - plan.slots, 0)  # of leaders: where the surplus of their voxel begins
    by_size = _stable_order(m - sizes)
    sizes, starts = (jnp.pad(x[by_size], (0, MERGE_BLOCKS[0][0])) for x in (sizes, starts))

    def merge_block(block, state):
        pivots, round_idx, first = state
        sizes_here = jax.lax.dynamic_slice(sizes, (first,), (block,))
        positions = jax.lax.dynamic_slice(starts, (first,), (block,)) + round_idx
        tokens = _unsigned(plan.order[jnp.minimum(positions, m - 1)])
        rows = jnp.where(sizes_here > round_idx, plan.rows[tokens], -1)
        arrivals = {name: _read(x, tokens) for name, x in new.items()}
        pivots = _merge_closest(pivots, arrivals, rows, config)
        is_over = sizes[first + block] <= round_idx
        return pivots, round_idx + is_over.astype(jnp.int32), jnp.where(is_over, 0, first + block)

    state = (pivots, jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32))
    for block, min_voxels in MERGE_BLOCKS:
        if min_voxels <= m:
            state = jax.lax.while_loop(
                lambda s, min_voxels=min_voxels: (s[2] > 0) | (sizes[min_voxels - 1] > s[1]),
                lambda s, block=block: merge_block(block, s),
                state,
            )
    return state[0]


def _merge_closest(pivots: Fields, new: Fields, rows: Int[Array, " b"], config: StreamConfig) -> Fields:
    """Inserts one token into each of the full voxels `rows` by merging the closest pair (-1: no voxel)."""
    k = config.memory.pivots_per_voxel
    starts = jnp.maximum(rows, 0)[:, None] * k
    seeds = _read(pivots["seeds"], starts + jnp.arange(k))
    first, second = _closest_pair(jnp.concatenate([seeds, new["seeds"][:, None]], axis=1))
    takes_new = second == k
    places = starts + jnp.stack([first, jnp.minimum(second, k - 1)], axis=1)
    pairs = {name: _read(x, places) for name, x in pivots.items()}
    older = {name: x[:, 0] for name, x in pairs.items()}
    newer = {name: _select(takes_new, new[name], x[:, 1]) for name, x in pairs.items()}
    merged = _merge_pair(older, newer)
    values = {name: jnp.stack([x, new[name].astype(x.dtype)], axis=1) for name, x in merged.items()}
    is_written = (rows >= 0)[:, None] & jnp.stack([jnp.ones_like(takes_new), ~takes_new], axis=1)
    return _write(pivots, jnp.where(is_written, places, -1), values)


def _closest_pair(keys: Array) -> tuple[Int[Array, " b"], Int[Array, " b"]]:
    """Indices i < j of the pair of `keys` `[b, k + 1, c]` with the largest cosine; the lowest pair among equals.

    Pairs are compared by cos |cos| = dot |dot| / (norm^2 norm^2), which orders them as the cosine does but takes no
    root, whose rounding would break ties: for features of small integers, equal cosines compare as equal. All pairs
    above `SAME_DIRECTION` count as equal.
    """
    b, num_keys, c = keys.shape
    lanes = math.gcd(c, 8)
    # Partial sums in lanes: XLA's CPU backend vectorizes a sum over a major axis but not over the minor one.
    keys = keys.astype(jnp.float32).reshape(b, num_keys, c // lanes, lanes)
    dot = lambda x, y: jnp.sum(jnp.sum(x * y, axis=-2), axis=-1)  # noqa: E731
    firsts, seconds = (jnp.array(x, jnp.int32) for x in zip(*itertools.combinations(range(num_keys), 2), strict=True))
    norms, dots = dot(keys, keys), dot(keys[:, firsts], keys[:, seconds])
    products = norms[:, firsts] * norms[:, seconds]
    in_range = (products > np.finfo(np.float32).tiny) & (products < np.inf)
    scores = jnp.where(in_range, dots * jnp.abs(dots) / jnp.where(in_range, products, 1.0), 0.0)
    best = jnp.argmax(jnp.where(scores > SAME_DIRECTION, 1.0, scores), axis=-1)
    return firsts[best], seconds[best]


def _merge_pair(older: Fields, newer: Fields) -> Fields:
    """Merged pivots (Eq. vacc_pair_selection_and_merge); `older` holds those of the lower slot.

    Means, features, colors and changes are averaged by confidence; observations and numbers of members add up. Seed,
    orientation, footprint and confidence are those of the more confident one.
    """
    weight_older, weight_newer = older["confidences"], newer["confidences"]
    newer_is_best = weight_newer > weight_older
    # The paper's weights, though weights by number of members gave 0.01 dB more on redkitchen and 0.04 on fox.
    total = weight_older + weight_newer
    share = jnp.where(total > 0, weight_newer / jnp.where(total > 0, total, 1.0), 0.5)

    def average(name):
        # Interpolated and clipped: rounding cannot take a mean out of its voxel.
        a, b = older[name].astype(jnp.float32), newer[name].astype(jnp.float32)
        return jnp.clip(a + share[:, None] * (b - a), jnp.minimum(a, b), jnp.maximum(a, b))

    merged = {name: average(name) for name in ("means", "feats", "rgbs", "changes") if name in older}
    best = ("seeds", "confidences", "quats", "footprints")
    merged |= {name: _select(newer_is_best, newer[name], older[name]) for name in best}
    merged |= {name: older[name] + newer[name] for name in ("num_members", "observations") if name in older}
    return merged | {"last_chunks": jnp.maximum(older["last_chunks"], newer["last_chunks"])}


def _read(x: Array, places: Integer[Array, "*b"]) -> Array:
    """`x` at valid places."""
    return x.at[_unsigned(places)].get(mode="promise_in_bounds")


def _write(pivots: Fields, places: Int[Array, "*b"], values: Fields) -> Fields:
    """`pivots` with `values` at distinct places; those of -1 are skipped."""
    places = _unsigned(places)
    return {name: x.at[places].set(values[name].astype(x.dtype), mode="drop") for name, x in pivots.items()}


def _unsigned(indices: Integer[Array, "*b"]) -> UInt32[Array, "*b"]:
    """`indices` for reading and writing; -1 becomes the largest number, which `mode="drop"` skips.

    JAX wraps signed indices with four operations at each use; unsigned ones need none.
    """
    return indices.astype(jnp.uint32)


def _select(condition, x, y):
    """`where` along the first axis."""
    return jnp.where(condition.reshape(condition.shape + (1,) * (x.ndim - 1)), x.astype(y.dtype), y)
