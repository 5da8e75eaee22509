"""Scene deltas: the Gaussians that changed since the last update, for a viewer or a file.

    feed = SceneFeed(model, params)
    for chunk in chunks:
        cache, _ = step(params, cache, chunk)
        delta = feed.update(cache)          # decodes only the rows that changed
        scene = apply_delta(scene, delta)   # equals model.decode(params, cache)

A step does not report what it touched, so that streams without a follower pay nothing. A voxel's Gaussians change
when a token is written to it, which the cache records per pivot (`last_chunks`); when views carve a pivot away or
restore it; and, with evidence, when views see a shown pivot. The feed detects the last two by comparing the shown
pivots and their observations with the previous ones.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float32, Int, Int32

from ssplat_jax.cache.state import VoxelCache, require_single_cache
from ssplat_jax.cache.votes import total_weight
from ssplat_jax.core.gaussians import Gaussians, mask_gaussians
from ssplat_jax.core.numerics import power_of_two
from ssplat_jax.model.streamsplat import StreamSplat, shown_pivots

MIN_DECODED_ROWS = 256
"""Decoded rows are padded to a power of two of at least this number, so that few programs are compiled."""


@dataclasses.dataclass(frozen=True)
class SceneDelta:
    """The voxels that changed and all their Gaussians now, including absent ones (opacity 0)."""

    rows: Int32[np.ndarray, " r"]  # ascending
    gaussians: Gaussians  # [r * k], in the order of `rows`; k = pivots_per_voxel * gaussians_per_token
    capacity: int  # capacity of the cache: the scene has capacity * k Gaussians


class _Record(NamedTuple):
    """State of a cache at the last delta."""

    next_chunk: int
    shown: Bool[np.ndarray, "n k"]
    seen: Float32[np.ndarray, "n k"]  # total weight of the observations


class SceneFeed:
    """The source of deltas of one stream. Call `update` after any number of chunks.

    Args:
        model: the stream's model.
        params: the model's parameters.
        known: the cache of the scene that the receiver already has; by default it has none.
    """

    def __init__(self, model: StreamSplat, params: dict, known: VoxelCache | None = None) -> None:
        self._params, k = params, model.config.memory.pivots_per_voxel
        self._shown_pivots = jax.jit(lambda cache: shown_pivots(cache, model.config))
        self._total_weight = jax.jit(total_weight)
        self._decode_rows = jax.jit(lambda params, cache, rows: model.decode_rows(params, cache, _pivots_of(rows, k)))
        self._record = _Record(0, np.zeros((0, k), bool), np.zeros((0, k), np.float32))
        if known is not None:
            self._record = self._changes(known)[1]

    def update(self, cache: VoxelCache) -> SceneDelta:
        """The changes since the last call.

        Raises:
            InputError: `cache` holds several caches, of streams or shards.
        """
        require_single_cache(cache, "SceneFeed.update")
        rows, record = self._changes(cache)
        num_padded = max(MIN_DECODED_ROWS, power_of_two(len(rows)))
        padded = np.pad(rows, (0, num_padded - len(rows)), constant_values=-1)
        gaussians = self._decode_rows(self._params, cache, jnp.asarray(padded))
        per_row = gaussians.num_gaussians // num_padded
        gaussians = jax.block_until_ready(jax.tree.map(lambda x: x[: per_row * len(rows)], gaussians))
        self._record = record  # last: after an error or an interrupt the changes are found again
        return SceneDelta(rows, gaussians, cache.capacity)

    def _changes(self, cache: VoxelCache) -> tuple[Int32[np.ndarray, " r"], _Record]:
        """Rows written, carved, restored or, with evidence, seen since the last call, and the record after them."""
        last = self._record
        more = [(0, cache.capacity - len(last.shown)), (0, 0)]  # the cache may have grown
        shown, seen = np.asarray(self._shown_pivots(cache)), last.seen
        is_changed = np.asarray(cache.alive) & (np.asarray(cache.last_chunks) >= last.next_chunk)
        is_changed |= shown != np.pad(last.shown, more)
        if cache.observations is not None:
            seen = np.asarray(self._total_weight(cache.observations))
            is_changed |= shown & (seen != np.pad(last.seen, more))
        rows = np.flatnonzero(is_changed.any(axis=1)).astype(np.int32)
        return rows, _Record(int(cache.stats.num_chunks), shown, seen)


def _pivots_of(rows: Int[Array, " r"], k: int) -> Int[Array, " m"]:
    """Numbers of all pivots of the voxels `rows`, -1 for a row of -1."""
    return jnp.where(rows[:, None] >= 0, rows[:, None] * k + jnp.arange(k), -1).reshape(-1)


def apply_delta(scene: Gaussians | None, delta: SceneDelta) -> Gaussians:
    """`scene` with the changes of `delta`: row for row what `decode` gives, once a delta was not empty.

    `scene` is None before the first delta.
    """
    if not len(delta.rows):
        return delta.gaussians if scene is None else scene
    per_row = delta.gaussians.num_gaussians // len(delta.rows)
    one = jax.tree.map(lambda x: jnp.zeros((1, *x.shape[1:]), x.dtype), delta.gaussians)
    absent = mask_gaussians(one, jnp.zeros((1,), bool))  # as `decode` writes it

    def merge(known, values, absent) -> np.ndarray:
        """`known`, filled up with `absent` to the capacity of `delta`, with `values` in the delta's rows."""
        merged = np.repeat(np.asarray(absent), max(delta.capacity * per_row, len(known)), axis=0)
        merged[: len(known)] = known
        merged.reshape(-1, per_row, *merged.shape[1:])[delta.rows] = values.reshape(-1, per_row, *merged.shape[1:])
        return merged

    scene = jax.tree.map(lambda x: x[:0], delta.gaussians) if scene is None else scene
    return jax.tree.map(merge, scene, delta.gaussians, absent)
