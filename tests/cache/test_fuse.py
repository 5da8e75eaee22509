"""The parallel fuse equals the sequential reference, and keeps the laws of the cache."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ssplat_jax.cache.fuse import MERGE_BLOCKS
from ssplat_jax.cache.fuse import fuse as plain_fuse
from ssplat_jax.cache.hash_table import voxel_indices
from ssplat_jax.cache.state import PIVOT_FIELDS, Tokens, VoxelCache, init_cache
from ssplat_jax.core.pytree import replace
from tests.cache import numpy_reference as reference
from tests.cache import streams

CONFIGS = streams.VARIANTS | {
    "single": streams.CONFIG.replace(pivots_per_voxel=1),
    "refined": streams.PAIRS.replace(steps_per_chunk=1),
}
SETTINGS = settings(max_examples=25, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
EMPTY = init_cache(streams.CONFIG, streams.CAPACITY)


def run(stream, config=streams.CONFIG, capacity=streams.CAPACITY) -> VoxelCache:
    cache = init_cache(config, capacity)
    for recipe in stream:
        cache = streams.fuse(cache, streams.to_jax(recipe.tokens()), config)
    return cache


def fused(tokens: Tokens, config=streams.CONFIG) -> VoxelCache:
    return streams.fuse(jax.tree.map(jnp.copy, EMPTY), tokens, config)


# The reference --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", CONFIGS)
@SETTINGS
@given(st.lists(streams.recipes, min_size=1, max_size=3))
def test_fuse_equals_the_reference(name, stream):
    streams.run_both(stream, CONFIGS[name])


def test_merge_rounds_of_every_size_equal_the_reference():
    """One chunk whose rounds have more voxels than the largest block, fewer than the smallest, and all between."""
    rng = np.random.default_rng(0)
    repeats = np.concatenate([np.full(MERGE_BLOCKS[0][0] + 64, 5), [7, 9] * 20, [30] * 5, [60]])
    columns = rng.permutation(np.repeat(np.arange(len(repeats)), repeats))
    m = len(columns)
    tokens = {
        "means": (np.stack([columns, 0 * columns, 0 * columns], axis=-1) + rng.uniform(0.1, 0.9, (m, 3))) / 4,
        "feats": rng.integers(-2, 3, (m, streams.WIDTH)),
        "confidences": rng.choice([0.5, 0.5, 1.0], m),
        "rgbs": rng.uniform(size=(m, 3 * streams.CONFIG.head.gaussians_per_token)),
        "quats": rng.normal(size=(m, 4)),
        "footprints": rng.uniform(0.26, 0.49, m),
    }
    tokens = {name: x.astype(np.float32) for name, x in tokens.items()} | {"valid": np.ones(m, bool)}
    cache = streams.fuse(init_cache(streams.CONFIG, 1024), streams.to_jax(tokens), streams.CONFIG)
    streams.assert_equal_to_reference(cache, reference.fuse(reference.empty(1024), tokens, streams.CONFIG))


# Laws -----------------------------------------------------------------------------------------------------------------


@SETTINGS
@given(st.lists(streams.recipes, min_size=1, max_size=4))
def test_pivots_are_bounded_inside_their_voxels_findable_and_counted(stream):
    cache = jax.tree.map(np.asarray, run(stream))
    rows = np.arange(streams.CAPACITY) < cache.num_voxels
    assert np.all(cache.counts[rows] >= 1) and np.all(cache.counts[~rows] == 0)
    assert np.all(cache.counts <= streams.CONFIG.memory.pivots_per_voxel) and cache.num_voxels <= streams.CAPACITY
    for name in PIVOT_FIELDS:
        assert not np.any(getattr(cache, name)[~cache.alive]), f"dead pivots hold zeros: {name}"
    voxels, in_range = voxel_indices(jnp.asarray(cache.means), jnp.asarray(cache.footprints), streams.CONFIG)
    where = np.broadcast_to(cache.voxels[:, None], voxels.shape)
    np.testing.assert_array_equal(np.asarray(voxels)[cache.alive], where[cache.alive])
    assert np.all(np.asarray(in_range)[cache.alive])
    assert len({tuple(v) for v in cache.voxels[rows]}) == cache.num_voxels
    assert sorted(cache.table[cache.table >= 0]) == list(range(cache.num_voxels))
    stats = jax.tree.map(int, cache.stats)
    left_out = stats.num_low_confidence + stats.num_non_finite + stats.num_out_of_range + stats.num_dropped
    assert stats.num_seen == sum(r.num_valid for r in stream) == stats.num_accepted + left_out


def test_a_token_without_a_positive_footprint_is_left_out_and_counted():
    cache = fused(streams.tokens_at([[0.1, 0.1, 0.1]] * 5, footprints=jnp.array([-0.3, 0.0, jnp.nan, jnp.inf, 0.3])))
    assert (int(cache.stats.num_non_finite), int(cache.stats.num_accepted)) == (4, 1)
    np.testing.assert_allclose(np.asarray(cache.footprints)[np.asarray(cache.alive)], 0.3)


@SETTINGS
@given(st.lists(streams.recipes, min_size=1, max_size=3), st.integers(1, streams.NUM_TOKENS - 1))
def test_splitting_a_chunk_changes_nothing(stream, at):
    whole, split = init_cache(streams.CONFIG, streams.CAPACITY), init_cache(streams.CONFIG, streams.CAPACITY)
    for recipe in stream:
        tokens = streams.to_jax(recipe.tokens())
        head = jnp.arange(streams.NUM_TOKENS) < at
        whole = streams.fuse(whole, tokens, streams.CONFIG)
        split = streams.fuse(split, replace(tokens, valid=tokens.valid & head), streams.CONFIG)
        split = streams.fuse(split, replace(tokens, valid=tokens.valid & ~head), streams.CONFIG)
    means = ("means", "feats", "rgbs")
    for name in {"voxels", "counts", "num_voxels", *PIVOT_FIELDS} - {"last_chunks", *means}:
        np.testing.assert_array_equal(getattr(whole, name), getattr(split, name), name)
    for name in means:
        a, b = np.asarray(getattr(whole, name)), np.asarray(getattr(split, name))
        np.testing.assert_allclose(a, b, rtol=0, atol=streams.VALUE_RTOL * np.abs(a).max(initial=1e-30))
    for name in ("num_seen", "num_accepted", "num_merged", "num_dropped"):
        assert int(getattr(whole.stats, name)) == int(getattr(split.stats, name))


@pytest.mark.parametrize("places", ["few", "edges"])
def test_padding_is_the_identity(places):
    before = run([streams.Recipe(seed=5, places=places, features="normal", confidences="random")])
    padding = streams.to_jax(streams.Recipe(6, places, "normal", "random", num_valid=0, num_bad=5).tokens())
    after = streams.fuse(jax.tree.map(jnp.copy, before), padding, streams.CONFIG)
    jax.tree.map(np.testing.assert_array_equal, before, after)


def test_no_gradient_passes_the_cache():
    tokens = streams.to_jax(streams.Recipe(seed=9, places="one_voxel", features="normal", confidences="tied").tokens())

    def loss(feats, means):
        cache = plain_fuse(EMPTY, replace(tokens, feats=feats, means=means), streams.CONFIG)
        return jnp.sum(cache.feats) + jnp.sum(cache.means)

    grads = jax.jit(jax.grad(loss, argnums=(0, 1)))(tokens.feats, tokens.means)
    assert not any(np.any(np.asarray(g)) for g in grads)


@pytest.mark.parametrize("name", streams.VARIANTS)
def test_fuse_runs_in_place_with_memory_free_of_capacity(name):
    def analysis(capacity):
        config = streams.VARIANTS[name].replace(capacity=capacity)
        cache = jax.eval_shape(lambda: init_cache(config))
        tokens = jax.eval_shape(lambda: streams.to_jax(streams.Recipe(0, "few", "normal", "random").tokens()))
        compiled = jax.jit(plain_fuse, static_argnums=2, donate_argnums=0).lower(cache, tokens, config).compile()
        return sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(cache)), compiled.memory_analysis()

    (small_size, small), (size, large) = analysis(128), analysis(1024)
    assert small.alias_size_in_bytes >= small_size and large.alias_size_in_bytes >= size
    per_row = {"voxel": 0, "append": 4}[name]  # "append" copies the counts
    assert large.temp_size_in_bytes <= small.temp_size_in_bytes + 64 + per_row * (1024 - 128)


# Limits stated by `fuse` ----------------------------------------------------------------------------------------------


def one_voxel(feats, confidences, means=None) -> Tokens:
    tokens = streams.Recipe(seed=10, places="one_voxel", features="normal", confidences="random").tokens()
    n = len(confidences)
    tokens["feats"][:n], tokens["confidences"][:n] = feats, confidences
    tokens["footprints"][:n] = 1.5 * streams.CONFIG.memory.voxel_size  # of one level
    if means is not None:
        tokens["means"][:n] = means
    tokens["valid"] = np.arange(streams.NUM_TOKENS) < n
    return streams.to_jax(tokens)


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e9, 1e12, 3e38])
def test_features_of_any_size_give_finite_pivots(size):
    """Eight of the twelve tokens merge. Within the limits of norms the closest pair does."""
    feats = size * np.random.default_rng(0).uniform(-1, 1, (12, 4))
    cache = fused(one_voxel(feats, np.linspace(0.3, 1.0, 12)))
    assert all(np.all(np.isfinite(np.asarray(getattr(cache, name)))) for name in PIVOT_FIELDS)
    assert int(cache.stats.num_merged) == 8
    if 1e-9 <= size <= 1e9:
        axes = size * np.eye(4)
        cache = fused(one_voxel(np.stack([*axes, axes[2] + 0.1 * axes[3]]), np.full(5, 0.5)))
        assert np.asarray(cache.num_members)[0].tolist() == [1, 1, 2, 1]


def test_merged_means_stay_between_their_members():
    """Hundreds of merges next to a voxel's upper corner, where rounding up would leave the voxel."""
    edge = np.nextafter(np.float32(0.25), np.float32(0))
    cache, rng = init_cache(streams.CONFIG, streams.CAPACITY), np.random.default_rng(0)
    for _ in range(20):
        confidences = rng.uniform(0.3, 1.0, streams.NUM_TOKENS)
        feats, means = rng.normal(size=(streams.NUM_TOKENS, 4)), np.full((streams.NUM_TOKENS, 3), edge)
        cache = streams.fuse(cache, one_voxel(feats, confidences, means), streams.CONFIG)
    np.testing.assert_array_equal(np.asarray(cache.means)[0], edge)
    assert int(cache.num_voxels) == 1 and int(cache.stats.num_merged) > 900
