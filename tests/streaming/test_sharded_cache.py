"""A sharded cache equals a single one, given the same tokens.

The shards are on the devices of other processes (`sharded_worker`), because this process has one device.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.cache import Tokens, fuse, init_cache, project
from ssplat_jax.cache.hash_table import shards_of
from ssplat_jax.cache.voxels import hash_voxels, voxel_indices
from ssplat_jax.config import StreamConfig
from ssplat_jax.core.pytree import replace
from tests.cache.projection_scenes import cameras
from tests.cache.streams import CONFIG, FEATURES, PLACES, Recipe
from tests.streaming.narrow_model import assert_same_bits
from tests.streaming.sharded_jobs import Worker, arrays, each_of, sorted_pivots, sorted_voxels

SUM_RTOL = 1e-6  # of the largest value: sums of about ten terms in another order; one float32 rounding is 6e-8
LONG_SUM_RTOL = 2e-5  # the same for sums of some thousand terms


def token_chunks(num_chunks: int = 4, num_recipes: int = 20) -> Tokens:
    """Chunks `[t, m, ...]` with all kinds of hard tokens; in each, some hundred voxels get more tokens than pivots."""

    def chunk(t):
        parts = []
        for i in range(num_recipes):
            places = ("few", *PLACES)[i % 6]
            recipe = Recipe(100 * t + i, places, FEATURES[i % 4], ("random", "at_tau")[i % 2], num_valid=44, num_bad=3)
            tokens = recipe.tokens()
            if places == "few":
                tokens["means"][:, 0] += 4 * CONFIG.memory.voxel_size * i
            parts.append(tokens)
        return Tokens(**{name: jnp.asarray(np.concatenate([x[name] for x in parts])) for name in parts[0]})

    return jax.tree.map(lambda *x: np.stack(x), *(chunk(t) for t in range(num_chunks)))


TOKENS = token_chunks()
CAMERA = arrays(cameras(5, num_views=3))
AMPLE = CONFIG.memory.capacity * 8
FUSED: dict[str, tuple[StreamConfig, int, int]] = {
    "voxels": (CONFIG, 8, AMPLE),
    "append": (CONFIG.replace(vacc="append"), 8, AMPLE),
    "drop_new": (CONFIG, 3, 32),
}
"""Configuration, number of shards, and capacity of each shard."""

COUNTERS = ("seen", "accepted", "merged", "low_confidence", "non_finite", "out_of_range", "dropped")


@functools.cache
def programs(config):
    """Jitted `fuse` and `project` of a single cache."""
    return jax.jit(functools.partial(fuse, config=config)), jax.jit(functools.partial(project, config=config))


def fuse_alone(config, capacity, valid):
    """A single cache after the tokens that are `valid`, and its projection."""
    insert, look = programs(config)
    cache = init_cache(config, capacity)
    for t in range(len(valid)):
        tokens = jax.tree.map(lambda x, t=t: jnp.asarray(x[t]), TOKENS)
        cache = insert(cache, replace(tokens, valid=jnp.asarray(valid[t])))
    return arrays(cache), arrays(look(cache, CAMERA))


@functools.cache
def fused_alone(config, capacity):
    """A single cache after all tokens, and its projection."""
    return fuse_alone(config, capacity, TOKENS.valid)


def fuse_job(name):
    config, num_shards, capacity = FUSED[name]
    tokens_and_camera = dict(tokens=TOKENS, camera=CAMERA)
    return "fuse_and_project", dict(config=config, num_shards=num_shards, capacity=capacity) | tokens_and_camera


@pytest.fixture(scope="module")
def fused(tmp_path_factory):
    """Shards and their projections: "voxels" from one process of eight devices, "append" from two of four."""

    @functools.cache
    def of(name: str):
        num_processes = {"voxels": 1, "append": 2}[name]
        worker = Worker(tmp_path_factory.mktemp(name), {"fused": fuse_job(name)}, 8 // num_processes, num_processes)
        results = worker.results()
        assert (results["num_devices"], results["num_processes"]) == (8, num_processes)
        return tuple(each_of(x) for x in results["fused"])

    return of


APPEND = pytest.param("append", marks=pytest.mark.slow)


def assert_same_voxels(shards, alone):
    found, wanted = sorted_voxels(shards), sorted_voxels([alone])
    assert len(wanted["voxels"]) > 500 and int(alone.stats.num_merged) > 500
    for field, values in wanted.items():
        np.testing.assert_array_equal(found[field], values, err_msg=field)


def assert_same_projection(of_shards, wanted, rtol):
    assert wanted.mask.mean() > 0.3
    for projected in of_shards:
        assert_same_bits(projected, of_shards[0])
    np.testing.assert_array_equal(of_shards[0].mask, wanted.mask)
    for field in ("depths", "confidences", "feats"):
        x, y = getattr(of_shards[0], field), getattr(wanted, field)
        np.testing.assert_allclose(x, y, rtol=0, atol=rtol * np.abs(y).max(), err_msg=field)


def test_sharded_voxels_equal_those_of_a_single_cache(fused):
    assert_same_voxels(fused("voxels")[0], fused_alone(CONFIG, AMPLE)[0])


@pytest.mark.parametrize(
    ("name", "rtol"), [("voxels", SUM_RTOL), pytest.param("append", LONG_SUM_RTOL, marks=pytest.mark.slow)]
)
def test_all_shards_get_the_projection_of_a_single_cache(fused, name, rtol):
    config, _, capacity = FUSED[name]
    assert_same_projection(fused(name)[1], fused_alone(config, capacity)[1], rtol)


@pytest.mark.parametrize("name", ["voxels", APPEND])
def test_one_shard_counts_each_token_and_all_count_each_chunk(fused, name):
    config, _, capacity = FUSED[name]
    shards, (alone, _) = fused(name)[0], fused_alone(config, capacity)
    for reason in ("merged", "low_confidence", "non_finite", "out_of_range"):
        assert int(getattr(alone.stats, f"num_{reason}")) > 0 or (reason, name) == ("merged", "append")
    for counter in COUNTERS:
        total = sum(int(getattr(shard.stats, f"num_{counter}")) for shard in shards)
        assert total == int(getattr(alone.stats, f"num_{counter}")), counter
    assert [int(shard.stats.num_chunks) for shard in shards] == [len(TOKENS.valid)] * len(shards)


@pytest.mark.slow
def test_appended_pivots_equal_those_of_a_single_cache(fused):
    config, _, capacity = FUSED["append"]
    found, wanted = sorted_pivots(fused("append")[0]), sorted_pivots([fused_alone(config, capacity)[0]])
    assert len(wanted) > 1500
    np.testing.assert_array_equal(found, wanted)


@pytest.mark.slow
def test_full_shard_equals_a_full_cache_of_its_own_tokens(tmp_path):
    config, num_shards, capacity = FUSED["drop_new"]
    results = Worker(tmp_path, {"fused": fuse_job("drop_new")}, num_devices=num_shards).results()
    shards = each_of(results["fused"][0])
    owners = np.asarray(shards_of(voxel_indices(jnp.asarray(TOKENS.means), config.memory.voxel_size)[0], num_shards))
    for i, shard in enumerate(shards):
        cache, _ = fuse_alone(config, capacity, TOKENS.valid & (owners == i))
        assert int(cache.num_voxels) == capacity and int(cache.stats.num_dropped) > 20
        assert_same_bits(shard, cache)


@pytest.mark.parametrize("num_shards", [2, 3, 8, 100])
def test_voxels_are_split_evenly_over_shards(num_shards):
    side = jnp.arange(-16, 16, dtype=jnp.int32)
    voxels = jnp.stack(jnp.meshgrid(side, side, side), axis=-1).reshape(-1, 3)
    shards = np.asarray(shards_of(voxels, num_shards))
    counts = np.bincount(shards, minlength=num_shards)
    expected = len(voxels) / num_shards
    # Five standard deviations of a random split.
    assert len(counts) == num_shards and np.abs(counts - expected).max() < 5 * np.sqrt(expected)


@pytest.mark.slow
def test_two_processes_equal_a_single_cache(tmp_path):
    results = Worker(tmp_path, {"fused": fuse_job("voxels")}, num_devices=4, num_processes=2).results()
    shards, projections = (each_of(x) for x in results["fused"])
    alone, seen = fused_alone(CONFIG, AMPLE)
    assert_same_voxels(shards, alone)
    assert_same_projection(projections, seen, SUM_RTOL)


def test_up_to_65536_shards_are_used():
    voxels = jnp.stack(jnp.meshgrid(*(jnp.arange(40, dtype=jnp.int32),) * 3), axis=-1)
    shards = np.asarray(shards_of(voxels, 1 << 16))
    np.testing.assert_array_equal(shards, np.asarray(hash_voxels(voxels)) >> 16)
    assert shards.min() < 100 and shards.max() > 65400
