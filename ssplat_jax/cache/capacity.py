"""What happens when the cache is full.

    grow          the host doubles the capacity before a step that might not fit (`ensure_room`)
    drop_new      tokens of new voxels are left out and counted
    evict_lowest  the voxels of least confidence make way, those seen longest ago first among equals
    error         as drop_new; `check_cache` raises

Inside jit nothing raises: what was lost is a number in `cache.stats`, and `check_cache` reads it on the host:

    cache = ensure_room(cache, config, num_new_tokens)
    cache, out = step(params, cache, chunk)
    check_cache(cache, config)
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from ssplat_jax.cache.hash_table import build_table
from ssplat_jax.cache.state import PIVOT_FIELDS, VoxelCache
from ssplat_jax.config import StreamConfig
from ssplat_jax.errors import CacheError, InputError
from ssplat_jax.pytree import replace


def ensure_room(cache: VoxelCache, config: StreamConfig, num_new_tokens: int) -> VoxelCache:
    """`cache`, doubled as often as needed to hold `num_new_tokens` more even if each opens a new voxel.

    Outside jit, and only for `overflow="grow"`; otherwise `cache` itself. Rows keep their numbers, so the stream goes
    on exactly as if the cache had had this capacity from the start. A new capacity compiles the step anew, which
    doubling keeps to log2 of the final size.
    """
    if config.memory.overflow != "grow":
        return cache
    capacity = roomy_capacity(cache.capacity, int(cache.num_voxels), num_new_tokens, config)
    return cache if capacity == cache.capacity else grow(cache, capacity)


def roomy_capacity(capacity: int, num_voxels: int, num_new_tokens: int, config: StreamConfig) -> int:
    """`capacity`, doubled as often as needed for `num_new_tokens` that all open voxels beside the `num_voxels` held."""
    new_rows = num_new_tokens if config.memory.vacc == "voxel" else -(-num_new_tokens // config.memory.pivots_per_voxel)
    while capacity < num_voxels + new_rows:
        capacity *= 2
    return capacity


def grow(cache: VoxelCache, capacity: int) -> VoxelCache:
    """`cache` with room for `capacity` voxels, a power of two.

    Raises:
        InputError: fewer than now, or no power of two.
    """
    extra = capacity - cache.capacity
    if extra < 0 or capacity & (capacity - 1):
        raise InputError(f"cache: capacity must be a power of two of at least {cache.capacity}, got {capacity}.")
    fields = {
        name: jnp.pad(x, [(0, extra)] + [(0, 0)] * (x.ndim - 1))
        for name in ("voxels", "counts", *PIVOT_FIELDS)
        for x in (getattr(cache, name),)
    }
    # Rows that no table leads to (vacc="append") have no voxels of their own to be entered by.
    num_entered = jnp.where(jnp.any(cache.table >= 0), cache.num_voxels, 0)
    return replace(cache, table=jax.jit(build_table)(fields["voxels"], num_entered), **fields)


def check_cache(cache: VoxelCache, config: StreamConfig) -> None:
    """Raises if the cache lost something that its policy promises to keep; call it outside jit.

    Raises:
        CacheError: tokens were dropped for want of room under `overflow` "grow" or "error".
    """
    check_dropped(int(np.asarray(cache.stats.num_dropped)), cache.capacity, config)


def check_dropped(num_dropped: int, capacity: int, config: StreamConfig) -> None:
    """Raises if `num_dropped` tokens found no room in `capacity` voxels and the policy does not allow that.

    Raises:
        CacheError: as `check_cache`.
    """
    if num_dropped and config.memory.overflow == "grow":
        raise CacheError(
            f"cache: {num_dropped} tokens found no room in {capacity} voxels; "
            "call cache.ensure_room(cache, config, num_new_tokens) before each step."
        )
    if num_dropped and config.memory.overflow == "error":
        raise CacheError(
            f"cache: {num_dropped} tokens found no room in {capacity} voxels; raise capacity to "
            f"{2 * capacity} or voxel_size above {config.memory.voxel_size}, or choose overflow='grow'."
        )


def evict(
    cache: VoxelCache, touched_rows: Int[Array, " m"], num_needed: Int[Array, ""]
) -> tuple[VoxelCache, Int[Array, " m"], Int[Array, ""]]:
    """Empties `num_needed` rows, or as many as there are beside `touched_rows` (-1: none).

    First go the voxels whose best pivot has the lowest confidence; among equals the one written longest ago, then the
    lowest row. Returns the cache with those rows zeroed but their table entries left, the rows (-1 after the last) and
    the number of pivots lost. Ranking the voxels costs a sort of the capacity, in the steps that overflow only.
    """
    m, capacity = touched_rows.shape[0], cache.capacity

    def rank():
        is_kept = (
            jnp.zeros((capacity,), jnp.int32)
            .at[jnp.where(touched_rows < 0, capacity, touched_rows)]
            .set(1, mode="drop")
        )
        rows = jnp.arange(capacity, dtype=jnp.int32)
        is_kept = jnp.where(rows < cache.num_voxels, is_kept, 1)
        keys = (is_kept, jnp.max(cache.confidences, axis=1), jnp.max(cache.last_chunks, axis=1), rows)
        ranked = jax.lax.sort(keys, num_keys=4, is_stable=False)[3]
        num_victims = jnp.minimum(num_needed, capacity - jnp.sum(is_kept))
        ranked = jnp.pad(ranked[:m], (0, max(m - capacity, 0)), constant_values=-1)
        return jnp.where(jnp.arange(m) < num_victims, ranked, -1)

    victims = jax.lax.cond(num_needed > 0, rank, lambda: jnp.full((m,), -1, jnp.int32))
    places = jnp.where(victims < 0, capacity, victims)
    num_lost = jnp.sum(jnp.where(victims < 0, 0, cache.counts[victims]), dtype=jnp.int32)
    emptied = {name: getattr(cache, name).at[places].set(0, mode="drop") for name in ("counts", *PIVOT_FIELDS)}
    return replace(cache, **emptied), victims, num_lost
