"""A sharded stream equals streams on one device: the cache's voxels to the last bit, whole steps to rounding.

The steps run on the devices of two other processes (`main`), because this process has one device.
"""

import functools
import pickle
import socket
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import NamedSharding
from jax.sharding import PartitionSpec as P

from ssplat_jax.cache.fuse import fuse
from ssplat_jax.cache.hash_table import shards_of
from ssplat_jax.cache.project import project
from ssplat_jax.cache.state import PIVOT_FIELDS, check_cache, grow, init_cache
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.streaming.sharded import ShardedStream
from tests.cache.projection_scenes import cameras
from tests.cache.streams import CONFIG, FEATURES, PLACES, Recipe, to_jax
from tests.cache.streams import fuse as fuse_alone
from tests.model.small import random_params
from tests.streaming.narrow_model import NARROW, assert_same_bits

SUM_RTOL = 1e-6  # of the largest value: sums of about ten terms in another order; one float32 rounding is 6e-8
STEP_RTOL = 1e-4  # of the largest value: rounding of the sums, which passes through the network with every chunk
FLIPPED = 0.005  # share of voxels or pivots that such rounding may place or pair differently
MODEL_CONFIG = NARROW.replace(capacity=4096, voxel_size=0.3, detail=False)  # voxels so large that many tokens merge
PADDED_STEP = 2  # the step of the first stream that is padding
TIMEOUT = 300  # seconds; a run usually takes some twenty


def on_two_processes(folder, job):
    """Results of `steps` on four devices of two processes."""
    (folder / "job.pkl").write_bytes(pickle.dumps(job))
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", __name__, str(folder)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    processes = [subprocess.Popen([*command, str(process), "2", str(port)], **pipes) for process in range(2)]
    try:
        for process in processes:
            log, _ = process.communicate(timeout=TIMEOUT)
            assert process.returncode == 0, log
    finally:
        for process in processes:
            process.kill()
    return pickle.loads((folder / "results.pkl").read_bytes())


def part(tree, *place):
    return jax.tree.map(lambda x: x[place], tree)


def stacked(trees):
    return jax.tree.map(lambda *x: np.stack(x), *trees)


def sorted_voxels(shards):
    """Voxels and pivots of all shards, sorted by voxel index."""
    fields = {
        name: np.concatenate([np.asarray(getattr(cache, name))[: int(cache.num_voxels)] for cache in shards])
        for name in ("voxels", "counts", *PIVOT_FIELDS)
    }
    order = np.lexsort(fields["voxels"].T)
    return {name: x[order] for name, x in fields.items()}


# The cache ------------------------------------------------------------------------------------------------------------


def test_shards_together_hold_and_show_what_a_single_cache_does():
    """Chunks of all kinds of hard tokens, on shards that are mapped over one device."""
    recipes = [Recipe(i, PLACES[i % 5], FEATURES[i % 4], ("random", "at_tau")[i % 2], 44, 3) for i in range(20)]
    chunks = [to_jax(recipe.tokens()) for recipe in recipes]
    start, camera = init_cache(CONFIG, 1024), cameras(5, num_views=3)
    shards, alone = jax.tree.map(lambda x: jnp.stack([x] * 4), start), start
    mapped = functools.partial(jax.vmap, axis_name="voxels", in_axes=(0, None))
    insert = jax.jit(mapped(functools.partial(fuse, config=CONFIG, axis="voxels")))
    for tokens in chunks:
        shards, alone = insert(shards, tokens), fuse_alone(alone, tokens, CONFIG)
    wanted = sorted_voxels([alone])
    assert len(wanted["voxels"]) > 200 and int(alone.stats.num_merged) > 150
    for name, values in sorted_voxels([part(shards, i) for i in range(4)]).items():
        np.testing.assert_array_equal(values, wanted[name], err_msg=name)
    # Each token is counted by one shard, each chunk by all.
    for name, count in vars(alone.stats).items():
        totals = np.asarray(getattr(shards.stats, name))
        assert (totals == count).all() if name == "num_chunks" else totals.sum() == count, name
    found = mapped(functools.partial(project, config=CONFIG, axis="voxels"))(shards, camera)
    seen = project(alone, camera, CONFIG)
    np.testing.assert_array_equal(found.mask, np.stack([seen.mask] * 4))
    assert seen.mask.any()
    for name in ("depths", "confidences", "feats"):
        x, y = np.asarray(getattr(found, name)), np.asarray(getattr(seen, name))
        np.testing.assert_allclose(x, np.stack([y] * 4), rtol=0, atol=SUM_RTOL * np.abs(y).max(), err_msg=name)


@pytest.mark.parametrize("num_shards", [2, 3, 100])
def test_voxels_are_split_evenly_over_shards(num_shards):
    side = jnp.arange(-16, 16, dtype=jnp.int32)
    voxels = jnp.stack(jnp.meshgrid(side, side, side, jnp.zeros(1, jnp.int32)), axis=-1).reshape(-1, 4)
    counts = np.bincount(np.asarray(shards_of(voxels, num_shards)), minlength=num_shards)
    expected = len(voxels) / num_shards
    # Five standard deviations of a random split.
    assert len(counts) == num_shards and np.abs(counts - expected).max() < 5 * np.sqrt(expected)


# Steps ----------------------------------------------------------------------------------------------------------------


def assert_close(found, wanted, name):
    wrong = np.abs(found.astype(np.float64) - wanted) > STEP_RTOL * np.abs(wanted).max()
    assert wrong.mean() <= FLIPPED, f"{name}: {wrong.sum()} of {wrong.size}"


def assert_close_cache(shards, cache):
    found, wanted = sorted_voxels(shards), sorted_voxels([cache])
    places = {tuple(row): i for i, row in enumerate(found["voxels"])}
    rows = [(places[tuple(row)], i) for i, row in enumerate(wanted["voxels"]) if tuple(row) in places]
    assert len(rows) >= (1 - FLIPPED) * max(len(found["voxels"]), len(wanted["voxels"])) > 50
    in_found, in_wanted = np.array(rows).T
    for name in found:
        assert_close(found[name][in_found], wanted[name][in_wanted], name)
    for name in ("num_seen", "num_accepted"):
        assert sum(int(getattr(shard.stats, name)) for shard in shards) == int(getattr(cache.stats, name))


@pytest.mark.slow  # two networks compiled in two processes
def test_streams_together_equal_each_stream_alone(tmp_path):
    """Two streams, one interrupted by padding and one in reverse order, on four devices of two processes."""
    captured = list(open_capture("procedural:room?frames=12&size=64x64").chunks(MODEL_CONFIG))
    captured = jax.tree.map(np.asarray, captured)
    padding = jax.tree.map(np.copy, captured[0])
    padding.valid[:] = False
    streams = [[*captured[:PADDED_STEP], padding, captured[2]], [*captured[::-1], captured[0]]]
    params = jax.tree.map(np.asarray, random_params(MODEL_CONFIG, seed=1))
    chunks = stacked([stacked(pair) for pair in zip(*streams, strict=True)])
    capacity = 8 * MODEL_CONFIG.memory.capacity
    job = dict(config=MODEL_CONFIG, params=params, chunks=chunks, num_new_tokens=capacity // 2)
    history, num_compilations, scenes, grown = on_two_processes(tmp_path, job)
    assert num_compilations == 1
    model = StreamSplat(MODEL_CONFIG)
    step = jax.jit(model.step, compiler_options={"xla_backend_optimization_level": 0})
    for stream, inputs in enumerate(streams):
        cache = model.init_cache()
        for t, chunk in enumerate(inputs):
            caches, output = history[t]
            shards = [part(caches, stream, shard) for shard in range(2)]
            if (stream, t) == (0, PADDED_STEP):
                assert_same_bits(part(caches, 0), part(history[t - 1][0], 0))  # padding changes nothing
                continue
            cache, expected = step(params, cache, chunk)
            for name in ("depths", "confidences", "history"):
                assert_close(getattr(output, name)[stream], np.asarray(getattr(expected, name)), name)
            assert_close_cache(shards, cache)
            assert_same_bits(shards[0].stored_depths, shards[1].stored_depths)
        assert int(cache.stats.num_merged) > 100
        opacities = scenes.opacities[stream]
        np.testing.assert_allclose(opacities.sum(), model.decode(params, cache).opacities.sum(), rtol=STEP_RTOL)
        for i, shard in enumerate(shards):
            assert_same_bits(part(grown, stream, i), grow(jax.tree.map(jnp.asarray, shard), capacity))


# A process with two devices, which steps a stream together with others -----------------------------------------------


def steps(mesh, config, params, chunks, num_new_tokens):
    """Caches and outputs of every step over `chunks` `[t, streams, ...]`, the last scenes, and the grown caches."""
    sharded = ShardedStream(StreamSplat(config), mesh)
    params, step = on_mesh(mesh, P(), params), jax.jit(sharded.step, donate_argnums=1)
    caches, history = sharded.init_cache(chunks.valid.shape[1]), []
    for t in range(len(chunks.valid)):
        caches, output = step(params, caches, on_mesh(mesh, P("streams"), jax.tree.map(lambda x, t=t: x[t], chunks)))
        history.append(everywhere(mesh, (caches, output)))
    check_cache(caches, sharded.model.config)
    grown = sharded.ensure_capacity(caches, num_new_tokens)
    return history, step._cache_size(), *everywhere(mesh, (jax.jit(sharded.decode)(params, caches), grown))


def on_mesh(mesh, spec, tree):
    """`tree`, which every process has, placed on the devices of the mesh."""
    sharding = NamedSharding(jax.sharding.Mesh(mesh.devices, mesh.axis_names), spec)
    return jax.tree.map(lambda x: jax.make_array_from_callback(x.shape, sharding, lambda part: x[part]), tree)


def everywhere(mesh, tree):
    """The whole arrays, on the host of every process."""
    sharding = NamedSharding(jax.sharding.Mesh(mesh.devices, mesh.axis_names), P())
    return jax.tree.map(np.asarray, jax.jit(unchanged, out_shardings=sharding)(tree))


def unchanged(tree):
    """The identity; a function of the module, so that it is compiled once for each structure."""
    return tree


def main(folder, process, num_processes, port):
    jax.config.update("jax_num_cpu_devices", 2)
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    jax.config.update("jax_disable_most_optimizations", True)  # they take longer than the steps
    jax.distributed.initialize(f"localhost:{port}", num_processes, process)
    mesh = jax.make_mesh((2, num_processes), ("streams", "voxels"))
    results = steps(mesh, **pickle.loads((folder / "job.pkl").read_bytes()))
    if process == 0:
        (folder / "results.pkl").write_bytes(pickle.dumps(results))


if __name__ == "__main__":
    main(Path(sys.argv[1]), *(int(x) for x in sys.argv[2:]))
