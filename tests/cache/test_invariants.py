"""Invariants of the cache: bounds, repetition, rejection, padding, translation, gradients and memory."""

import resource
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ssplat_jax.cache import PIVOT_FIELDS, Tokens, VoxelCache, init_cache
from ssplat_jax.cache import fuse as plain_fuse
from ssplat_jax.cache import numpy_reference as reference
from ssplat_jax.cache.voxels import voxel_indices
from ssplat_jax.core.pytree import replace
from tests.cache.streams import (
    CAPACITY,
    CONFIG,
    NUM_TOKENS,
    PAIRS,
    PLACES,
    VALUE_RTOL,
    VARIANTS,
    Recipe,
    assert_same_cache,
    fuse,
    fuse_with_rows,
    recipes,
    to_jax,
)

SETTINGS = settings(max_examples=30, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))


def run(stream, config=CONFIG, capacity=CAPACITY) -> VoxelCache:
    cache = init_cache(config, capacity)
    for recipe in stream:
        cache = fuse(cache, to_jax(recipe.tokens()), config)
    return cache


# Bounds --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("config", [CONFIG, PAIRS], ids=["four pivots", "two pivots"])
@SETTINGS
@given(st.lists(recipes, min_size=1, max_size=4))
def test_pivots_are_bounded_inside_their_voxels_and_findable(config, stream):
    cache = jax.tree.map(np.asarray, run(stream, config))
    rows = np.arange(CAPACITY) < cache.num_voxels
    assert np.all(cache.counts[rows] >= 1) and np.all(cache.counts[~rows] == 0)
    assert np.all(cache.counts <= config.memory.pivots_per_voxel) and cache.num_voxels <= CAPACITY
    for name in PIVOT_FIELDS:
        assert not np.any(getattr(cache, name)[~cache.alive]), f"dead pivots hold zeros: {name}"
    voxels, in_range = voxel_indices(jnp.asarray(cache.means), config.memory.voxel_size)
    where = np.broadcast_to(cache.voxels[:, None], voxels.shape)
    np.testing.assert_array_equal(np.asarray(voxels)[cache.alive], where[cache.alive])
    assert np.all(np.asarray(in_range)[cache.alive])
    assert len({tuple(v) for v in cache.voxels[rows]}) == cache.num_voxels
    assert sorted(cache.table[cache.table >= 0]) == list(range(cache.num_voxels))


@SETTINGS
@given(st.lists(recipes, min_size=2, max_size=4))
def test_every_token_is_counted_once(stream):
    stats = jax.tree.map(int, run(stream).stats)
    left_out = stats.num_low_confidence + stats.num_non_finite + stats.num_out_of_range + stats.num_dropped
    assert stats.num_seen == sum(r.num_valid for r in stream)
    assert stats.num_seen == stats.num_accepted + left_out


@SETTINGS
@given(st.lists(recipes, min_size=1, max_size=3), st.integers(1, NUM_TOKENS - 1))
def test_splitting_a_chunk_changes_nothing(stream, at):
    whole, split = init_cache(CONFIG, CAPACITY), init_cache(CONFIG, CAPACITY)
    for recipe in stream:
        tokens = to_jax(recipe.tokens())
        head = jnp.arange(NUM_TOKENS) < at
        whole = fuse(whole, tokens, CONFIG)
        split = fuse(split, replace(tokens, valid=tokens.valid & head), CONFIG)
        split = fuse(split, replace(tokens, valid=tokens.valid & ~head), CONFIG)
    assert_same_cache(whole, split, except_fields=("table", "last_chunks", "means", "feats", "rgbs"))
    for name in ("means", "feats", "rgbs"):
        a, b = np.asarray(getattr(whole, name)), np.asarray(getattr(split, name))
        np.testing.assert_allclose(a, b, rtol=0, atol=VALUE_RTOL * np.abs(a).max(initial=1e-30))
    for name in ("num_seen", "num_accepted", "num_merged", "num_dropped"):
        assert int(getattr(whole.stats, name)) == int(getattr(split.stats, name))


# Repetition ----------------------------------------------------------------------------------------------------------


def test_repeating_a_chunk_adds_and_moves_no_pivots():
    """With fewer distinct tokens in a voxel than pivots, repetitions merge only with themselves."""
    tokens = Recipe(seed=1, places="many", features="normal", confidences="random").tokens()
    tokens["means"] = (
        np.repeat(np.arange(NUM_TOKENS // 3), 3)[:, None] * CONFIG.memory.voxel_size + tokens["means"] % 0.2 + 0.01
    )
    cache, after = init_cache(CONFIG, CAPACITY), []
    for _ in range(6):
        cache = fuse(cache, to_jax(tokens), CONFIG)
        after.append({tuple(p) for p in np.asarray(cache.means)[np.asarray(cache.alive)]})
    accepted = tokens["confidences"] >= np.float32(CONFIG.memory.min_confidence)
    assert after[0] == {tuple(p) for p in tokens["means"].astype(np.float32)[accepted]}
    assert all(positions == after[0] for positions in after)
    assert int(jnp.max(cache.counts)) <= CONFIG.memory.pivots_per_voxel
    assert int(cache.stats.num_merged) > 0


# Rejection -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "value", "counter"),
    [
        ("confidences", np.nextafter(np.float32(0.3), np.float32(0)), "num_low_confidence"),
        ("means", np.nan, "num_non_finite"),
        ("means", np.inf, "num_non_finite"),
        ("feats", -np.inf, "num_non_finite"),
        ("confidences", np.nan, "num_non_finite"),
        ("rgbs", np.nan, "num_non_finite"),
        ("quats", np.nan, "num_non_finite"),
        ("footprints", np.nan, "num_non_finite"),
        ("means", np.float32(1e30), "num_out_of_range"),
        ("means", np.float32(-(1 << 20) * 0.25), "num_out_of_range"),
    ],
)
def test_rejected_tokens_change_only_their_counter(name, value, counter):
    tokens = Recipe(seed=2, places="few", features="normal", confidences="tied").tokens()
    before = run([Recipe(seed=3, places="few", features="normal", confidences="tied")])
    tokens["confidences"][:] = 0.5
    tokens[name] = np.full_like(tokens[name], value)
    after, rows = fuse_with_rows(jax.tree.map(jnp.copy, before), to_jax(tokens), CONFIG)
    assert_same_cache(before, after)
    assert not rows
    added = jax.tree.map(lambda a, b: int(a) - int(b), after.stats, before.stats)
    assert getattr(added, counter) == NUM_TOKENS == added.num_seen
    assert added.num_accepted == 0


def test_token_at_tau_is_accepted():
    tokens = Recipe(seed=2, places="few", features="normal", confidences="tied").tokens()
    tokens["confidences"][:] = np.float32(0.3)
    cache = fuse(init_cache(CONFIG, CAPACITY), to_jax(tokens), CONFIG)
    assert int(cache.stats.num_accepted) == NUM_TOKENS


# Padding -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("places", PLACES)
def test_padding_is_the_identity(places):
    before = run([Recipe(seed=5, places=places, features="normal", confidences="random")])
    padding = to_jax(Recipe(6, places, "normal", "random", num_valid=0, num_bad=5).tokens())
    after, rows = fuse_with_rows(jax.tree.map(jnp.copy, before), padding, CONFIG)
    jax.tree.map(np.testing.assert_array_equal, before, after)
    assert not rows


# Translation ---------------------------------------------------------------------------------------------------------


def test_shifting_the_world_by_whole_voxels_shifts_the_pivots():
    """Voxel size and positions are dyadic, so the shift itself does not round."""
    tokens = Recipe(seed=7, places="few", features="integers", confidences="tied").tokens()
    tokens["means"] = np.round(tokens["means"] * 1024) / 1024
    shift = np.array([3, -5, 2]) * CONFIG.memory.voxel_size
    moved = tokens | {"means": (tokens["means"] + shift).astype(np.float32)}
    a = fuse(init_cache(CONFIG, CAPACITY), to_jax(tokens), CONFIG)
    b = fuse(init_cache(CONFIG, CAPACITY), to_jax(moved), CONFIG)
    assert int(a.stats.num_merged) > 0
    assert_same_cache(a, b, except_fields=("table", "means", "voxels"))
    expected = np.where(np.asarray(a.alive)[..., None], np.asarray(a.means) + shift.astype(np.float32), 0)
    np.testing.assert_allclose(b.means, expected, rtol=0, atol=2e-7)


def test_append_keeps_every_token_unchanged():
    config = CONFIG.replace(vacc="append")
    tokens = Recipe(seed=8, places="one_voxel", features="normal", confidences="random").tokens()
    cache = fuse(init_cache(config, CAPACITY), to_jax(tokens), config)
    accepted = tokens["confidences"] >= np.float32(config.memory.min_confidence)
    alive = np.asarray(cache.alive)
    for name in ("means", "feats", "confidences", "rgbs", "quats", "footprints"):
        np.testing.assert_array_equal(np.asarray(getattr(cache, name))[alive], tokens[name][accepted])


# Gradients -----------------------------------------------------------------------------------------------------------


def test_no_gradient_passes_the_cache():
    tokens = to_jax(Recipe(seed=9, places="one_voxel", features="normal", confidences="tied").tokens())

    def loss(feats, means):
        cache = plain_fuse(init_cache(CONFIG, CAPACITY), replace(tokens, feats=feats, means=means), CONFIG)
        return jnp.sum(cache.feats) + jnp.sum(cache.means)

    grads = jax.jit(jax.grad(loss, argnums=(0, 1)))(tokens.feats, tokens.means)
    assert not any(np.any(np.asarray(g)) for g in grads)


# Memory and compilation ----------------------------------------------------------------------------------------------


def test_one_compilation_for_a_whole_stream():
    traces = []

    def counted(cache, tokens):
        traces.append(1)
        return plain_fuse(cache, tokens, CONFIG)

    step, cache = jax.jit(counted, donate_argnums=0), init_cache(CONFIG, CAPACITY)
    for seed in range(6):
        recipe = Recipe(seed, PLACES[seed % len(PLACES)], "normal", "random", num_valid=8 * seed)
        cache = step(cache, to_jax(recipe.tokens()))
    assert len(traces) == 1


@pytest.mark.parametrize("name", VARIANTS)
def test_fuse_runs_in_place_with_memory_free_of_capacity(name):
    def analysis(capacity):
        config = VARIANTS[name].replace(capacity=capacity)
        cache = jax.eval_shape(lambda: init_cache(config))
        tokens = jax.eval_shape(lambda: to_jax(Recipe(0, "few", "normal", "random").tokens()))
        compiled = jax.jit(plain_fuse, static_argnums=2, donate_argnums=0).lower(cache, tokens, config).compile()
        size = sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(cache))
        return size, compiled.memory_analysis()

    small_size, small = analysis(128)
    size, large = analysis(1024)
    assert small.alias_size_in_bytes >= small_size and large.alias_size_in_bytes >= size
    per_row = {"voxel": 0, "append": 4}[name]  # "append" copies the counts
    assert large.temp_size_in_bytes <= small.temp_size_in_bytes + 64 + per_row * (1024 - 128)


# Rows written ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", VARIANTS)
def test_rows_without_a_token_stay_unchanged(name):
    """A copy that takes over only the rows written by each chunk equals the cache."""
    config = VARIANTS[name]
    cache = init_cache(config, CAPACITY)
    copy = {name: np.zeros(getattr(cache, name).shape) for name in ("counts", *PIVOT_FIELDS)}
    for seed, places in enumerate(("few", "many", "one_voxel", "many", "edges")):
        recipe = Recipe(seed, places, "normal", "random", num_valid=24)
        cache, written = fuse_with_rows(cache, to_jax(recipe.tokens()), config)
        rows = sorted(written)
        for name, x in copy.items():
            x[rows] = np.asarray(getattr(cache, name))[rows]
            np.testing.assert_array_equal(x, getattr(cache, name), name)


def test_bfloat16_features_choose_the_same_pivots():
    """Small integers are exact in bfloat16, so every choice must be the same; only means of features are rounded more.

    Other means may differ by float32 rounding, because XLA compiles another program.
    """
    stream = [Recipe(seed, "few", "integers", "tied").tokens() for seed in range(3)]
    exact, short = init_cache(CONFIG, CAPACITY), init_cache(CONFIG, CAPACITY)
    short = replace(short, feats=short.feats.astype(jnp.bfloat16), seeds=short.seeds.astype(jnp.bfloat16))
    for tokens in stream:
        exact = fuse(exact, to_jax(tokens), CONFIG)
        short = fuse(short, to_jax(tokens), CONFIG)
    assert short.feats.dtype == jnp.bfloat16 and int(short.stats.num_merged) > 0
    assert_same_cache(exact, short, except_fields=("feats", "means", "rgbs"))
    for name in ("means", "rgbs"):
        np.testing.assert_allclose(getattr(exact, name), getattr(short, name), rtol=VALUE_RTOL, atol=1e-7)
    np.testing.assert_allclose(exact.feats, short.feats.astype(jnp.float32), rtol=0, atol=0.03)  # 2 x 2^-8 per merge


# Soak ----------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_long_streams_keep_memory_and_counters_in_order():
    def resident_bytes():
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()

    config, cache = PAIRS, init_cache(PAIRS, CAPACITY)
    stream = [Recipe(seed, PLACES[seed % 5], "normal", "random", num_bad=5).tokens() for seed in range(50)]
    chunks = [to_jax(tokens) for tokens in stream]
    for i in range(10_000):
        cache = fuse(cache, chunks[i % 50], config)
        if i == 500:
            before = resident_bytes()
    assert resident_bytes() - before <= 50 * 2**20
    assert int(cache.num_voxels) <= CAPACITY and int(jnp.max(cache.counts)) <= config.memory.pivots_per_voxel
    stats = jax.tree.map(int, cache.stats)
    once = reference.empty(CAPACITY)
    for tokens in stream:
        reference.fuse(once, tokens, config)
    assert (stats.num_chunks, stats.num_seen) == (10_000, 10_000 * NUM_TOKENS)
    for name in ("num_low_confidence", "num_non_finite", "num_out_of_range"):  # of a token alone, whatever is cached
        assert getattr(stats, name) == 200 * once["stats"][name] > 0, name
    left_out = stats.num_low_confidence + stats.num_non_finite + stats.num_out_of_range + stats.num_dropped
    assert stats.num_accepted == stats.num_seen - left_out
    assert int(jnp.sum(cache.counts)) == stats.num_accepted - stats.num_merged


# Limits stated by `fuse` ---------------------------------------------------------------------------------------------


def one_voxel(feats, confidences, means=None) -> Tokens:
    tokens = Recipe(seed=10, places="one_voxel", features="normal", confidences="random").tokens()
    n = len(confidences)
    tokens["feats"][:n], tokens["confidences"][:n] = feats, confidences
    if means is not None:
        tokens["means"][:n] = means
    tokens["valid"] = np.arange(NUM_TOKENS) < n
    return to_jax(tokens)


@pytest.mark.parametrize("size", [0.0, 1e-9, 1.0, 1e9, 1e12, 3e38])
def test_features_of_any_size_give_finite_pivots(size):
    """Eight of the twelve tokens merge."""
    feats = size * np.random.default_rng(0).uniform(-1, 1, (12, 4))
    cache = fuse(init_cache(CONFIG, CAPACITY), one_voxel(feats, np.linspace(0.3, 1.0, 12)), CONFIG)
    assert all(np.all(np.isfinite(np.asarray(getattr(cache, name)))) for name in PIVOT_FIELDS)
    assert int(cache.stats.num_merged) == 8


@pytest.mark.parametrize("size", [1e-9, 1e9])
def test_closest_pair_is_found_at_the_limits_of_norms(size):
    axes = np.eye(4)
    feats = size * np.array([axes[0], axes[1], axes[2], axes[3], axes[2] + 0.1 * axes[3]])
    cache = fuse(init_cache(CONFIG, CAPACITY), one_voxel(feats, np.full(5, 0.5)), CONFIG)
    assert np.asarray(cache.num_members)[0].tolist() == [1, 1, 2, 1]


def test_zero_features_are_orthogonal_to_everything():
    feats = np.concatenate([np.zeros((4, 4)), np.ones((1, 4))])
    cache = fuse(init_cache(CONFIG, CAPACITY), one_voxel(feats, np.full(5, 0.5)), CONFIG)
    assert np.asarray(cache.num_members)[0].tolist() == [2, 1, 1, 1]  # all tied at 0: the lowest pair


def test_members_of_confidence_zero_average_with_equal_weights():
    config = CONFIG.replace(min_confidence=0.0)
    means = np.full((5, 3), 0.1) + np.array([0, 0, 0, 0, 0.1])[:, None]
    feats = np.stack([*np.eye(4), np.eye(4)[3]])
    cache = fuse(init_cache(config, CAPACITY), one_voxel(feats, np.zeros(5), means), config)
    np.testing.assert_allclose(cache.means[0, 3], 0.15, rtol=VALUE_RTOL)


def test_merged_means_stay_between_their_members():
    """Ten thousand merges next to a voxel's upper corner, where rounding up would leave the voxel."""
    edge = np.nextafter(np.float32(0.25), np.float32(0))
    cache = init_cache(CONFIG, CAPACITY)
    rng = np.random.default_rng(0)
    for _ in range(200):
        confidences = rng.uniform(0.3, 1.0, NUM_TOKENS)
        tokens = one_voxel(rng.normal(size=(NUM_TOKENS, 4)), confidences, np.full((NUM_TOKENS, 3), edge))
        cache = fuse(cache, tokens, CONFIG)
    np.testing.assert_array_equal(np.asarray(cache.means)[0], edge)
    assert int(cache.num_voxels) == 1


def test_new_token_of_equal_confidence_has_half_of_the_weight():
    values, config = np.arange(1.0, 9.0), CONFIG.replace(pivots_per_voxel=1)
    expected = 0.5**7 + np.sum(values[1:] * 0.5 ** np.arange(7, 0, -1))
    tokens = replace(one_voxel(np.ones((8, 4)), np.full(8, 0.5)), rgbs=jnp.zeros((NUM_TOKENS, 12)))
    tokens = replace(tokens, rgbs=tokens.rgbs.at[:8].set(jnp.asarray(values, jnp.float32)[:, None]))
    cache = fuse(init_cache(config, CAPACITY), tokens, config)
    np.testing.assert_allclose(cache.rgbs[0, 0], expected, rtol=VALUE_RTOL)
