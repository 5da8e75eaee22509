"""Overflow policies: growing changes no result, and dropped tokens are counted."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.cache.fuse import saturating_add
from ssplat_jax.cache.state import check_cache, ensure_capacity, grow, init_cache
from ssplat_jax.core.errors import CacheError, InputError
from ssplat_jax.core.pytree import replace
from ssplat_jax.streaming.session import starting_capacity
from tests.cache.streams import CONFIG, NUM_TOKENS, Recipe, fuse, to_jax
from tests.streaming.narrow_model import assert_same_bits

GROW = CONFIG.replace(overflow="grow")  # only the host reads it; inside jit it acts as `drop_new`
STREAM = [Recipe(seed, places, "normal", "random").tokens() for seed, places in enumerate(("many", "few", "many"))]


@pytest.mark.parametrize(("vacc", "final"), [("voxel", 128), ("append", 64)])
def test_growing_equals_starting_large(vacc, final):
    config = CONFIG.replace(vacc=vacc)
    small, large = init_cache(config, 16), init_cache(config, final)
    for tokens in STREAM:
        small = ensure_capacity(small, config.replace(overflow="grow"), NUM_TOKENS)
        small, large = (fuse(cache, to_jax(tokens), config) for cache in (small, large))
        check_cache(small, config.replace(overflow="grow"))
    assert small.capacity == final
    # The tables differ by the order of entry; with `append` they are empty and must stay so.
    assert_same_bits(small, large, except_fields=() if vacc == "append" else ("table",))


def test_capacity_grows_by_doubling_and_never_shrinks():
    cache = init_cache(GROW, 16)
    assert ensure_capacity(cache, GROW, 16) is cache
    assert ensure_capacity(cache, GROW, 17).capacity == 32
    assert ensure_capacity(cache, GROW, 1000).capacity == 1024
    assert ensure_capacity(cache, CONFIG, 1000) is cache  # another policy
    for refused in (lambda: grow(cache, 8), lambda: init_cache(CONFIG, 100)):
        with pytest.raises(InputError):
            refused()
    assert starting_capacity(CONFIG.replace(capacity=128, overflow="grow"), 50_000) == 1 << 18
    assert starting_capacity(CONFIG, 50_000) == CONFIG.memory.capacity


def test_stacked_caches_grow_alike_and_traced_ones_are_refused():
    caches = [init_cache(GROW, 16), fuse(init_cache(GROW, 16), to_jax(STREAM[0]), GROW)]
    stacked = ensure_capacity(jax.tree.map(lambda *x: jnp.stack(x), *caches), GROW, 17)
    assert stacked.capacity == 64
    for i, cache in enumerate(caches):
        jax.tree.map(np.testing.assert_array_equal, jax.tree.map(lambda x, i=i: x[i], stacked), grow(cache, 64))
    check_cache(stacked, CONFIG)  # its policy allows dropping
    with pytest.raises(CacheError, match="ensure_capacity"):
        check_cache(stacked, GROW)
    for call in (lambda cache: ensure_capacity(cache, GROW, 1), lambda cache: check_cache(cache, GROW)):
        with pytest.raises(InputError, match="outside jit"):
            jax.jit(call)(caches[0])


def test_counters_saturate_instead_of_overflowing():
    largest = 2**31 - 1
    for now, more, wanted in ((0, 5, 5), (largest - 3, 3, largest), (largest - 3, 4, largest), (largest,) * 3):
        assert int(saturating_add(jnp.int32(now), jnp.int32(more))) == wanted
    cache = init_cache(CONFIG, 16)
    full = replace(cache, stats=replace(cache.stats, num_seen=jnp.int32(largest)))
    assert int(fuse(full, to_jax(STREAM[0]), CONFIG).stats.num_seen) == largest
