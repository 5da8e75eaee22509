"""Overflow policies: what happens when the cache is full (`config.memory.overflow`).

    grow      the host doubles the capacity before a step that might not fit (`ensure_capacity`)
    drop_new  tokens that open a new voxel are dropped and counted

Nothing raises inside jit: losses are counted in `cache.stats`, and `check_cache` reads the counters on the host:

    cache = ensure_capacity(cache, config, num_new_tokens)
    cache, out = step(params, cache, chunk)
    check_cache(cache, config)
"""

import jax
import jax.numpy as jnp
import numpy as np

from ssplat_jax.cache.hash_table import build_table
from ssplat_jax.cache.state import VoxelCache, pivot_fields
from ssplat_jax.config import StreamConfig
from ssplat_jax.core.errors import CacheError, InputError
from ssplat_jax.core.pytree import replace


def ensure_capacity(cache: VoxelCache, config: StreamConfig, num_new_tokens: int) -> VoxelCache:
    """`cache`, doubled as often as needed to hold `num_new_tokens` more even if each opens a new voxel.

    Call it outside jit. Only `overflow="grow"` changes the cache. Rows keep their numbers, so the stream continues
    exactly as if the cache had had the new capacity from the start. The step is compiled again for a new capacity;
    doubling limits the number of compilations to log2 of the final size.

    Args:
        cache: the cache before a step.
        config: its `overflow` decides.
        num_new_tokens: tokens of the coming chunk, one per 4 x 4 pixels of the padded images
            (`ssplat_jax.streaming.session.tokens_per_chunk`).

    Returns:
        The cache itself, or a larger copy.

    Raises:
        InputError: the capacity of the cache is no power of two.
    """
    if config.memory.overflow != "grow":
        return cache
    capacity = required_capacity(cache.capacity, int(cache.num_voxels), num_new_tokens, config)
    return cache if capacity == cache.capacity else grow(cache, capacity)


def required_capacity(capacity: int, num_voxels: int, num_new_tokens: int, config: StreamConfig) -> int:
    """The capacity, doubled as often as needed, that holds all new tokens in the worst case.

    Args:
        capacity: present number of rows.
        num_voxels: rows that are occupied.
        num_new_tokens: tokens to come; in the worst case each opens a new voxel.
        config: `vacc` decides how many rows the new tokens can fill.

    Returns:
        `capacity` times a power of two.
    """
    new_rows = num_new_tokens if config.memory.vacc == "voxel" else -(-num_new_tokens // config.memory.pivots_per_voxel)
    while capacity < num_voxels + new_rows:
        capacity *= 2
    return capacity


def grow(cache: VoxelCache, capacity: int) -> VoxelCache:
    """`cache` enlarged to `capacity` voxels, a power of two.

    Raises:
        InputError: `capacity` is below the present one or no power of two.
    """
    extra = capacity - cache.capacity
    if extra < 0 or capacity & (capacity - 1):
        raise InputError(f"cache: capacity must be a power of two of at least {cache.capacity}, got {capacity}.")
    fields = {
        name: jnp.pad(x, [(0, extra)] + [(0, 0)] * (x.ndim - 1))
        for name in ("voxels", "counts", *pivot_fields(cache))
        for x in (getattr(cache, name),)
    }
    # With vacc="append" the table is empty: rows have no voxel of their own to be entered by.
    num_entered = jnp.where(jnp.any(cache.table >= 0), cache.num_voxels, 0)
    return replace(cache, table=jax.jit(build_table)(fields["voxels"], num_entered), **fields)


def check_cache(cache: VoxelCache, config: StreamConfig) -> None:
    """Raises if the cache lost tokens that its overflow policy promises to keep. Call it outside jit.

    Raises:
        CacheError: tokens were dropped under `overflow="grow"`.
    """
    check_dropped(int(np.asarray(cache.stats.num_dropped)), cache.capacity, config)


def check_dropped(num_dropped: int, capacity: int, config: StreamConfig) -> None:
    """Raises if `num_dropped` tokens did not fit in `capacity` voxels and the policy does not allow that.

    Raises:
        CacheError: as `check_cache`.
    """
    if num_dropped and config.memory.overflow == "grow":
        raise CacheError(
            f"cache: wanted to keep every token, but {num_dropped} did not fit in {capacity} voxels; "
            "call cache.ensure_capacity(cache, config, num_new_tokens) before each step."
        )
