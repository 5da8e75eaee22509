"""Overflow policies: growing changes no result, and the losses of the other policies are counted."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.cache import check_cache, ensure_capacity, grow, init_cache
from ssplat_jax.cache.hash_table import find_rows
from ssplat_jax.cache.state import saturating_add
from ssplat_jax.core.errors import CacheError, InputError
from ssplat_jax.core.pytree import replace
from ssplat_jax.streaming.session import starting_capacity
from tests.cache.streams import CONFIG, NUM_TOKENS, Recipe, assert_same_cache, fuse, to_jax

GROW = CONFIG.replace(overflow="grow")  # only the host reads it; inside jit it acts as `drop_new`
STREAM = [Recipe(seed, places, "normal", "random").tokens() for seed, places in enumerate(("many", "few", "many"))]


@pytest.mark.parametrize(("vacc", "final"), [("voxel", 128), ("append", 64)])
def test_growing_equals_starting_large(vacc, final):
    config = CONFIG.replace(vacc=vacc)
    small, large = init_cache(config, 16), init_cache(config, final)
    capacities = set()
    for tokens in STREAM:
        small = ensure_capacity(small, config.replace(overflow="grow"), NUM_TOKENS)
        capacities.add(small.capacity)
        small = fuse(small, to_jax(tokens), config)
        large = fuse(large, to_jax(tokens), config)
        check_cache(small, config.replace(overflow="grow"))
    jax.tree.map(np.testing.assert_array_equal, small.stats, large.stats)
    assert len(capacities) > 1 and small.capacity == final
    # The tables differ by the order of entry; with `append` they are empty and must stay so.
    assert_same_cache(small, large, except_fields=() if vacc == "append" else ("table",))


def test_every_voxel_is_found_after_growing():
    cache = fuse(init_cache(CONFIG, 64), to_jax(STREAM[0]), CONFIG)
    cache = grow(cache, 512)
    rows = find_rows(cache.table, cache.voxels, cache.voxels[:64], np.arange(64) < cache.num_voxels)
    n = int(cache.num_voxels)
    assert n > 10
    np.testing.assert_array_equal(rows, np.where(np.arange(64) < n, np.arange(64), -1))


def test_capacity_grows_by_doubling():
    cache = init_cache(GROW, 16)
    assert ensure_capacity(cache, GROW, 16) is cache
    assert ensure_capacity(cache, GROW, 17).capacity == 32
    assert ensure_capacity(cache, GROW, 1000).capacity == 1024
    assert ensure_capacity(cache, CONFIG, 1000) is cache  # another policy


def test_capacity_never_shrinks():
    with pytest.raises(InputError, match="at least 32"):
        grow(init_cache(GROW, 32), 16)


def test_drop_new_keeps_old_voxels_and_counts_the_rest():
    cache = init_cache(CONFIG, 16)
    for tokens in STREAM:
        before = cache.voxels[: int(cache.num_voxels)].copy()
        cache = fuse(cache, to_jax(tokens), CONFIG)
        np.testing.assert_array_equal(cache.voxels[: len(before)], before)
    assert int(cache.num_voxels) == 16
    assert int(cache.stats.num_dropped) > 0
    check_cache(cache, CONFIG)  # the policy allows dropping


def test_check_cache_raises_with_the_remedy():
    config = CONFIG.replace(overflow="grow")
    cache = init_cache(config, 16)
    check_cache(cache, config)
    for tokens in STREAM:
        cache = fuse(cache, to_jax(tokens), CONFIG)
    with pytest.raises(CacheError, match="ensure_capacity"):
        check_cache(cache, config)


@pytest.mark.parametrize("capacity", [0, -4, 100])
def test_capacity_must_be_a_power_of_two(capacity):
    with pytest.raises(InputError, match="power of two"):
        init_cache(CONFIG, capacity)


@pytest.mark.parametrize(("policy", "wanted"), [("grow", 1 << 18), ("drop_new", 128)])
def test_session_starts_larger_only_if_the_cache_may_grow(policy, wanted):
    assert starting_capacity(CONFIG.replace(capacity=128, overflow=policy), 50_000) == wanted


def test_counters_saturate_instead_of_overflowing():
    largest = 2**31 - 1
    for now, more, wanted in ((0, 5, 5), (largest - 3, 3, largest), (largest - 3, 4, largest), (largest,) * 3):
        assert int(saturating_add(jnp.int32(now), jnp.int32(more))) == wanted
    cache = init_cache(CONFIG)
    full = replace(cache, stats=replace(cache.stats, num_seen=jnp.int32(largest)))
    assert int(fuse(full, to_jax(STREAM[0]), CONFIG).stats.num_seen) == largest
