"""Several devices give what one gives. The devices are in other processes (parallel_worker.py): this one has one."""

import functools
import pickle
import socket
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.cache import PIVOT_FIELDS, Tokens, VoxelCache, fuse, grow, init_cache, project
from ssplat_jax.cache.hash_table import shards_of
from ssplat_jax.config import StreamConfig
from ssplat_jax.data.capture import open_capture
from ssplat_jax.errors import CacheError, InputError
from ssplat_jax.geometry.voxels import hash_voxels, voxel_indices
from ssplat_jax.pytree import replace
from ssplat_jax.streaming.sharded import ShardedStream, _as_on_first_shard
from ssplat_jax.streaming.streamsplat import StreamSplat
from tests.cache.streams import CONFIG, FEATURES, PLACES, Recipe
from tests.cache.test_project_oracle import cameras
from tests.model.small import random_params
from tests.streaming.test_streamsplat import NARROW

SUM_RTOL = 1e-6  # of the largest value: sums of some ten terms in another order; one float32 rounding is 6e-8
LONG_SUM_RTOL = 2e-5  # the same for some thousand terms
TIMEOUT = 300  # seconds; some ten are usual


class Worker:
    """Jobs for `num_devices` in each of `num_processes`, begun at once."""

    def __init__(self, folder, jobs, num_devices=1, num_processes=1):
        self.folder = folder
        (folder / "jobs.pkl").write_bytes(pickle.dumps(jobs))
        with socket.socket() as free:
            free.bind(("localhost", 0))
            port = free.getsockname()[1]
        self.processes = [
            subprocess.Popen(
                [sys.executable, "-m", "tests.streaming.sharded_worker", folder]
                + [str(x) for x in (num_devices, process, num_processes, port)],
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
            )
            for process in range(num_processes)
        ]

    def results(self):
        """What the jobs returned."""
        try:
            for process in self.processes:
                said, _ = process.communicate(timeout=TIMEOUT)
                assert process.returncode == 0, said
        finally:
            for process in self.processes:
                process.kill()
        return pickle.loads((self.folder / "results.pkl").read_bytes())


def arrays(tree):
    return jax.tree.map(np.asarray, tree)


def part(tree, *place):
    """What `tree` holds at `place` of its leading axes."""
    return jax.tree.map(lambda x: x[place], tree)


def leaves_with_names(tree):
    return [(jax.tree_util.keystr(k), np.asarray(x)) for k, x in jax.tree_util.tree_flatten_with_path(tree)[0]]


def assert_same_bits(tree, wanted, but=()):
    for (name, x), (_, y) in zip(leaves_with_names(tree), leaves_with_names(wanted), strict=True):
        if name.rpartition(".")[2] not in but:
            np.testing.assert_array_equal(x, y, err_msg=name)


def sorted_voxels(shards: list[VoxelCache]) -> dict[str, np.ndarray]:
    """Voxels and their pivots of all shards, ordered by index."""
    occupied = [slice(0, int(cache.num_voxels)) for cache in shards]
    fields = {
        name: np.concatenate([getattr(cache, name)[rows] for cache, rows in zip(shards, occupied, strict=True)])
        for name in ("voxels", "counts", *PIVOT_FIELDS)
    }
    order = np.lexsort(fields["voxels"].T)
    return {name: x[order] for name, x in fields.items()}


def sorted_pivots(shards: list[VoxelCache]) -> np.ndarray:
    """All that is known of each living pivot, a row each, ordered by that."""
    alive = np.concatenate([np.asarray(cache.alive) for cache in shards])
    fields = [np.concatenate([getattr(cache, name) for cache in shards])[alive] for name in PIVOT_FIELDS]
    table = np.concatenate([x.reshape(len(x), -1).astype(np.float64) for x in fields], axis=1)
    return table[np.lexsort(table.T)]


# -- the cache, fed the same tokens ------------------------------------------------------------------------------------


def token_chunks(num_chunks: int = 4, num_recipes: int = 20) -> Tokens:
    """Chunks `[t, m, ...]` of all kinds of trouble; some hundred voxels overflow their pivots in every one."""

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
ROOMY = CONFIG.memory.capacity * 8
FUSED: dict[str, tuple[StreamConfig, int, int]] = {
    "voxels": (CONFIG, 8, ROOMY),
    "append": (CONFIG.replace(vacc="append"), 8, ROOMY),
    "evict_lowest": (CONFIG.replace(overflow="evict_lowest"), 3, 32),
}
"""Configurations, shards, and the capacity of each."""

COUNTERS = ("seen", "accepted", "merged", "low_confidence", "non_finite", "out_of_range", "dropped", "evicted")


@functools.cache
def programs(config):
    """Jitted `fuse` and `project` of one cache."""
    return jax.jit(functools.partial(fuse, config=config)), jax.jit(functools.partial(project, config=config))


def fuse_alone(config, capacity, valid):
    """One cache after those of the tokens that are `valid`, and its projection."""
    insert, look = programs(config)
    cache = init_cache(config, capacity)
    for t in range(len(valid)):
        tokens = jax.tree.map(lambda x, t=t: jnp.asarray(x[t]), TOKENS)
        cache = insert(cache, replace(tokens, valid=jnp.asarray(valid[t])))
    return arrays(cache), arrays(look(cache, CAMERA))


@functools.cache
def fused_alone(config, capacity):
    """One cache after all tokens, and its projection."""
    return fuse_alone(config, capacity, TOKENS.valid)


def fuse_job(name):
    config, num_shards, capacity = FUSED[name]
    tokens_and_camera = dict(tokens=TOKENS, camera=CAMERA)
    return "fuse_and_project", dict(config=config, num_shards=num_shards, capacity=capacity) | tokens_and_camera


def each_of(shards):
    """The trees stacked in `shards`."""
    return [part(shards, i) for i in range(len(jax.tree.leaves(shards)[0]))]


@pytest.fixture(scope="module")
def fused(tmp_path_factory):
    """Shards and their projections: by voxel from one process of eight devices, appended from two of four."""

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


def test_every_voxel_holds_what_it_would_in_one_cache(fused):
    assert_same_voxels(fused("voxels")[0], fused_alone(CONFIG, ROOMY)[0])


@pytest.mark.parametrize(
    ("name", "rtol"), [("voxels", SUM_RTOL), pytest.param("append", LONG_SUM_RTOL, marks=pytest.mark.slow)]
)
def test_all_shards_see_the_projection_of_one_cache(fused, name, rtol):
    config, _, capacity = FUSED[name]
    assert_same_projection(fused(name)[1], fused_alone(config, capacity)[1], rtol)


@pytest.mark.parametrize("name", ["voxels", APPEND])
def test_every_token_is_counted_by_one_shard_and_every_chunk_by_all(fused, name):
    config, _, capacity = FUSED[name]
    shards, (alone, _) = fused(name)[0], fused_alone(config, capacity)
    for reason in ("merged", "low_confidence", "non_finite", "out_of_range"):
        assert int(getattr(alone.stats, f"num_{reason}")) > 0 or (reason, name) == ("merged", "append")
    for counter in COUNTERS:
        total = sum(int(getattr(shard.stats, f"num_{counter}")) for shard in shards)
        assert total == int(getattr(alone.stats, f"num_{counter}")), counter
    assert [int(shard.stats.num_chunks) for shard in shards] == [len(TOKENS.valid)] * len(shards)


@pytest.mark.slow
def test_appended_pivots_are_those_of_one_cache(fused):
    config, _, capacity = FUSED["append"]
    found, wanted = sorted_pivots(fused("append")[0]), sorted_pivots([fused_alone(config, capacity)[0]])
    assert len(wanted) > 1500
    np.testing.assert_array_equal(found, wanted)


@pytest.mark.slow
def test_a_full_shard_is_a_full_cache_of_its_own_tokens(tmp_path):
    config, num_shards, capacity = FUSED["evict_lowest"]
    results = Worker(tmp_path, {"fused": fuse_job("evict_lowest")}, num_devices=num_shards).results()
    shards = each_of(results["fused"][0])
    owners = np.asarray(shards_of(voxel_indices(jnp.asarray(TOKENS.means), config.memory.voxel_size)[0], num_shards))
    for i, shard in enumerate(shards):
        cache, _ = fuse_alone(config, capacity, TOKENS.valid & (owners == i))
        assert int(cache.num_voxels) == capacity and int(cache.stats.num_evicted) > 20
        assert_same_bits(shard, cache)


@pytest.mark.parametrize("num_shards", [2, 3, 8, 100])
def test_shards_are_even_and_keep_the_tables_bits_apart(num_shards):
    side = jnp.arange(-16, 16, dtype=jnp.int32)
    voxels = jnp.stack(jnp.meshgrid(side, side, side), axis=-1).reshape(-1, 3)
    shards = np.asarray(shards_of(voxels, num_shards))
    counts = np.bincount(shards, minlength=num_shards)
    expected = len(voxels) / num_shards
    # Five standard deviations of a fair draw.
    assert len(counts) == num_shards and np.abs(counts - expected).max() < 5 * np.sqrt(expected)


@pytest.mark.slow
def test_two_processes_hold_what_one_cache_does(tmp_path):
    results = Worker(tmp_path, {"fused": fuse_job("voxels")}, num_devices=4, num_processes=2).results()
    shards, projections = (each_of(x) for x in results["fused"])
    alone, seen = fused_alone(CONFIG, ROOMY)
    assert_same_voxels(shards, alone)
    assert_same_projection(projections, seen, SUM_RTOL)


def test_there_may_be_as_many_shards_as_the_hash_has_high_bits_for():
    voxels = jnp.stack(jnp.meshgrid(*(jnp.arange(40, dtype=jnp.int32),) * 3), axis=-1)
    shards = np.asarray(shards_of(voxels, 1 << 16))
    np.testing.assert_array_equal(shards, np.asarray(hash_voxels(voxels)) >> 16)
    assert shards.min() < 100 and shards.max() > 65400


def test_shards_agree_on_what_the_first_computed():
    values = np.array([[1.5, -0.0, 0.0, np.nan, np.inf], [1.5000001, 7.0, -0.0, 1.0, -np.inf]], np.float32)
    flags = np.array([True, False])
    found, kept = jax.vmap(lambda x: _as_on_first_shard(x, "voxels"), axis_name="voxels")((values, flags))
    np.testing.assert_array_equal(found, values[[0, 0]])
    np.testing.assert_array_equal(kept, flags)


# -- the model, several streams at once --------------------------------------------------------------------------------

MODEL_CONFIG = NARROW.replace(capacity=4096, voxel_size=0.3)  # cells so large that many tokens merge
PADDED_STEP = 2  # of the first stream
STEP_RTOL = 1e-4  # of the largest value of a kind: rounding of the sums, once through the network with every chunk
FLIPPED = 0.005  # share of voxels or pivots that such rounding may place or pair otherwise


@pytest.fixture(scope="module")
def params():
    return arrays(random_params(MODEL_CONFIG, seed=1))


@pytest.fixture(scope="module")
def captured():
    return arrays(list(open_capture("procedural:room?frames=16&size=64x64").chunks(MODEL_CONFIG)))


def stacked(trees):
    return jax.tree.map(lambda *x: np.stack(x), *trees)


@pytest.fixture(scope="module")
def chunks(captured):
    """Two streams `[t, 2, ...]` of one capture, the second in the opposite order and with one chunk more.

    Padding interrupts the first.
    """
    padding = jax.tree.map(np.copy, captured[0])
    padding.valid[:] = False
    first = [*captured[:PADDED_STEP], padding, *captured[PADDED_STEP:]]
    second = [*captured[::-1], captured[0]]
    return stacked([stacked(pair) for pair in zip(first, second, strict=True)])


@pytest.fixture(scope="module")
def streamed(params, captured, chunks, tmp_path_factory):
    """The streams together on eight devices, and each alone on one."""
    shared = dict(config=MODEL_CONFIG, params=params)
    alone = shared | dict(streams=[captured, [*captured[::-1], captured[0]]])
    sharded = shared | dict(chunks=chunks, mesh_shape=(2, 4), num_new_tokens=4 * MODEL_CONFIG.memory.capacity)
    workers = [
        Worker(tmp_path_factory.mktemp(name), {name: job}, num_devices)
        for name, job, num_devices in (("alone", ("steps_alone", alone), 1), ("sharded", ("steps", sharded), 8))
    ]
    one, eight = (worker.results() for worker in workers)
    assert (one["num_devices"], eight["num_devices"]) == (1, 8)
    return {"alone": one["alone"], "sharded": eight["sharded"]}


def shards_of_stream(caches, stream):
    return [part(caches, stream, shard) for shard in range(caches.counts.shape[1])]


def assert_close(found, wanted, name):
    wrong = np.abs(found.astype(np.float64) - wanted) > STEP_RTOL * np.abs(wanted).max()
    assert wrong.mean() <= FLIPPED, f"{name}: {wrong.sum()} of {wrong.size}"


def assert_close_to_one_device(caches, outputs, stream, alone):
    """Caches and outputs of a stream's steps against those of its steps alone."""
    for cache, output, wanted_cache, wanted_output in zip(caches, outputs, *alone[:2], strict=True):
        for name in ("depths", "confidences", "history"):
            assert_close(getattr(output, name)[stream], getattr(wanted_output, name), name)
        shards = shards_of_stream(cache, stream)
        found, wanted = sorted_voxels(shards), sorted_voxels([wanted_cache])
        both, in_found, in_wanted = common_rows(found["voxels"], wanted["voxels"])
        assert both >= (1 - FLIPPED) * max(len(found["voxels"]), len(wanted["voxels"]))
        for name in found:
            assert_close(found[name][in_found], wanted[name][in_wanted], name)
        for shard in shards:
            assert int(shard.stats.num_chunks) == int(wanted_cache.stats.num_chunks)
            assert_same_bits(shard.witnesses, shards[0].witnesses)
        for counter in ("seen", "accepted"):
            total = sum(int(getattr(shard.stats, f"num_{counter}")) for shard in shards)
            assert total == int(getattr(wanted_cache.stats, f"num_{counter}")), counter


def common_rows(a, b):
    """How many rows of indices two tables share, and where they are in each."""
    places = {tuple(row): i for i, row in enumerate(a)}
    pairs = [(places[tuple(row)], i) for i, row in enumerate(b) if tuple(row) in places]
    in_a, in_b = np.array(pairs).T
    return len(pairs), in_a, in_b


@pytest.mark.slow
def test_streams_together_are_each_what_it_is_alone(streamed):
    sharded, alone = streamed["sharded"], streamed["alone"]
    is_padding = np.arange(len(sharded["caches"])) == PADDED_STEP
    merged = [int(caches[-1].stats.num_merged) for caches, _, _ in alone]
    assert min(merged) > 100
    for stream in range(2):
        steps = np.flatnonzero(~is_padding) if stream == 0 else np.arange(len(is_padding))
        kept, outputs = ([sharded[name][t] for t in steps] for name in ("caches", "outputs"))
        wanted = tuple(x[: len(steps)] for x in alone[stream][:2])
        assert len(steps) >= 4
        assert_close_to_one_device(kept, outputs, stream, wanted)


@pytest.mark.slow
def test_padding_of_one_stream_changes_nothing_of_it(streamed):
    before, after = (part(streamed["sharded"]["caches"][t], 0) for t in (PADDED_STEP - 1, PADDED_STEP))
    assert_same_bits(after, before)
    assert int(before.num_voxels.min()) > 50


@pytest.mark.slow
def test_one_compilation_for_all_steps(streamed):
    assert streamed["sharded"]["num_compilations"] == 1


@pytest.mark.slow
def test_scenes_are_those_of_the_shards(params, streamed):
    gaussians = streamed["sharded"]["gaussians"]
    for stream, (_, _, wanted) in enumerate(streamed["alone"]):
        found = gaussians.opacities[stream]
        k, per_pivot = MODEL_CONFIG.memory.pivots_per_voxel, MODEL_CONFIG.head.gaussians_per_token
        assert found.shape == (4 * MODEL_CONFIG.memory.capacity * k * per_pivot,)
        shards = shards_of_stream(streamed["sharded"]["caches"][-1], stream)
        alive = np.concatenate([shard.alive.reshape(-1) for shard in shards])
        np.testing.assert_array_equal(found > 0, alive.repeat(per_pivot))
        if stream:
            np.testing.assert_allclose(found.sum(), wanted.opacities.sum(), rtol=STEP_RTOL)


@pytest.mark.slow
def test_all_shards_grow_alike_and_keep_what_they_hold(streamed):
    caches, grown = streamed["sharded"]["caches"][-1], streamed["sharded"]["grown"]
    capacity = 8 * MODEL_CONFIG.memory.capacity
    assert grown.voxels.shape == (2, 4, capacity, 3)
    for stream in range(2):
        for shard, larger in zip(shards_of_stream(caches, stream), shards_of_stream(grown, stream), strict=True):
            assert_same_bits(larger, grow(jax.tree.map(jnp.asarray, shard), capacity))


@pytest.mark.slow
def test_scan_equals_loop_bit_for_bit(params, chunks, streamed, tmp_path):
    job = ("scanned", dict(config=MODEL_CONFIG, params=params, chunks=chunks, mesh_shape=(2, 4)))
    caches, outputs = Worker(tmp_path, {"scanned": job}, num_devices=8).results()["scanned"]
    assert_same_bits(caches, streamed["sharded"]["caches"][-1])
    assert_same_bits(outputs, stacked(streamed["sharded"]["outputs"]))


@pytest.mark.slow
def test_a_device_takes_several_streams_one_after_another(params, chunks, streamed, tmp_path):
    job = ("steps", dict(config=MODEL_CONFIG, params=params, chunks=chunks, mesh_shape=(1, 4)))
    found = Worker(tmp_path, {"steps": job}, num_devices=4).results()["steps"]
    assert found["num_compilations"] == 1
    for name in ("caches", "outputs", "gaussians"):
        assert_same_bits(found[name], streamed["sharded"][name])


@pytest.mark.slow
def test_two_processes_stream_as_one_device(params, captured, streamed, tmp_path):
    one_stream = stacked([stacked([chunk]) for chunk in captured])
    arguments = dict(config=MODEL_CONFIG, params=params, chunks=one_stream, mesh_shape=(1, 4))
    job = ("steps", arguments | dict(num_new_tokens=4 * MODEL_CONFIG.memory.capacity))
    results = Worker(tmp_path, {"steps": job}, num_devices=2, num_processes=2).results()
    assert (results["num_devices"], results["num_processes"]) == (4, 2)
    found = results["steps"]
    assert found["num_compilations"] == 1 and found["grown"].voxels.shape[2] == 8 * MODEL_CONFIG.memory.capacity
    assert_close_to_one_device(found["caches"], found["outputs"], 0, streamed["alone"][0])


# -- on the one device of this process ---------------------------------------------------------------------------------


def mesh_of_one(axes=("streams", "voxels")) -> jax.sharding.Mesh:
    return jax.sharding.Mesh(np.array(jax.devices()[:1]).reshape(1, 1), axes)


def test_a_mesh_without_the_axes_is_refused():
    with pytest.raises(InputError, match=r"'streams' and 'voxels', got \('data', 'voxels'\)"):
        ShardedStream(StreamSplat(NARROW), mesh_of_one(("data", "voxels")))
    with pytest.raises(InputError, match="another for voxels"):
        ShardedStream(StreamSplat(NARROW), mesh_of_one(), streams="voxels")
    assert ShardedStream(StreamSplat(NARROW), mesh_of_one(("data", "voxels")), streams="data").streams == "data"


def test_streams_that_do_not_divide_over_the_rows_are_refused():
    two_rows = jax.sharding.Mesh(np.array(jax.devices()[:1] * 2).reshape(2, 1), ("streams", "voxels"))
    with pytest.raises(InputError, match="multiple of the mesh's 2, got 3"):
        ShardedStream(StreamSplat(NARROW), two_rows).init_cache(3)


@pytest.mark.parametrize(("overflow", "advice"), [("grow", "ensure_room"), ("error", "raise capacity to 256")])
def test_what_a_shard_drops_is_an_error_where_the_policy_says_so(overflow, advice):
    sharded = ShardedStream(StreamSplat(NARROW.replace(overflow=overflow, capacity=128)), mesh_of_one())
    caches = sharded.init_cache(2)
    sharded.check(caches)
    is_dropped = lambda path: path[-1].name == "num_dropped"  # noqa: E731
    dropped = jax.tree_util.tree_map_with_path(lambda path, x: x.at[1].set(3) if is_dropped(path) else x, caches)
    with pytest.raises(CacheError, match=f"3 tokens found no room in 128 voxels.*{advice}"):
        sharded.check(dropped)


def test_caches_with_room_or_that_may_not_grow_stay_as_they_are():
    for overflow, num_new_tokens in (("grow", 128), ("drop_new", 1000)):
        sharded = ShardedStream(StreamSplat(NARROW.replace(overflow=overflow, capacity=128)), mesh_of_one())
        caches = sharded.init_cache()
        assert sharded.ensure_room(caches, num_new_tokens) is caches
