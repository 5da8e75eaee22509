"""Steps of sharded streams equal those on one device, to rounding.

The shards are on the devices of other processes (`sharded_worker`), because this process has one device.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.cache import grow
from ssplat_jax.data.open_capture import open_capture
from tests.model.small import random_params
from tests.streaming.narrow_model import NARROW, assert_same_bits
from tests.streaming.sharded_jobs import Worker, arrays, part, sorted_voxels, stacked

MODEL_CONFIG = NARROW.replace(capacity=4096, voxel_size=0.3)  # voxels so large that many tokens merge
PADDED_STEP = 2  # the step of the first stream that is padding
STEP_RTOL = 1e-4  # of the largest value: rounding of the sums, which passes through the network with every chunk
FLIPPED = 0.005  # share of voxels or pivots that such rounding may place or pair differently


@pytest.fixture(scope="module")
def params():
    return arrays(random_params(MODEL_CONFIG, seed=1))


@pytest.fixture(scope="module")
def captured():
    return arrays(list(open_capture("procedural:room?frames=16&size=64x64").chunks(MODEL_CONFIG)))


@pytest.fixture(scope="module")
def chunks(captured):
    """Two streams `[t, 2, ...]` of one capture: one interrupted by padding, one in reverse order and a chunk longer."""
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
    """Compares caches and outputs of a stream's steps with those of the stream on one device, `alone`."""
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
    """Number of index rows that two tables share, and their positions in each."""
    places = {tuple(row): i for i, row in enumerate(a)}
    pairs = [(places[tuple(row)], i) for i, row in enumerate(b) if tuple(row) in places]
    in_a, in_b = np.array(pairs).T
    return len(pairs), in_a, in_b


@pytest.mark.slow
def test_streams_together_equal_each_stream_alone(streamed):
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
def test_padding_leaves_its_stream_unchanged(streamed):
    before, after = (part(streamed["sharded"]["caches"][t], 0) for t in (PADDED_STEP - 1, PADDED_STEP))
    assert_same_bits(after, before)
    assert int(before.num_voxels.min()) > 50


@pytest.mark.slow
def test_one_compilation_for_all_steps(streamed):
    assert streamed["sharded"]["num_compilations"] == 1


@pytest.mark.slow
def test_scene_is_made_of_the_shards(params, streamed):
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
def test_shards_grow_alike_and_keep_their_contents(streamed):
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
def test_one_device_runs_several_streams(params, chunks, streamed, tmp_path):
    job = ("steps", dict(config=MODEL_CONFIG, params=params, chunks=chunks, mesh_shape=(1, 4)))
    found = Worker(tmp_path, {"steps": job}, num_devices=4).results()["steps"]
    assert found["num_compilations"] == 1
    for name in ("caches", "outputs", "gaussians"):
        assert_same_bits(found[name], streamed["sharded"][name])


@pytest.mark.slow
def test_two_processes_equal_one_device(params, captured, streamed, tmp_path):
    one_stream = stacked([stacked([chunk]) for chunk in captured])
    arguments = dict(config=MODEL_CONFIG, params=params, chunks=one_stream, mesh_shape=(1, 4))
    job = ("steps", arguments | dict(num_new_tokens=4 * MODEL_CONFIG.memory.capacity))
    results = Worker(tmp_path, {"steps": job}, num_devices=2, num_processes=2).results()
    assert (results["num_devices"], results["num_processes"]) == (4, 2)
    found = results["steps"]
    assert found["num_compilations"] == 1 and found["grown"].voxels.shape[2] == 8 * MODEL_CONFIG.memory.capacity
    assert_close_to_one_device(found["caches"], found["outputs"], 0, streamed["alone"][0])
