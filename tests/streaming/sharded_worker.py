"""A process of a sharded run, with several devices of its own; one or more of them work together.

    python -m tests.streaming.sharded_worker FOLDER NUM_DEVICES PROCESS NUM_PROCESSES PORT

Runs the jobs listed in FOLDER/jobs.pkl and writes their results, as arrays, to FOLDER/results.pkl. The tests are in
test_sharded_cache.py and test_sharded_steps.py.
"""

import pickle
import sys
from functools import partial
from pathlib import Path

from jaxtyping import install_import_hook

install_import_hook("ssplat_jax", "beartype.beartype")

import jax  # noqa: E402
import numpy as np  # noqa: E402
from jax.sharding import NamedSharding  # noqa: E402
from jax.sharding import PartitionSpec as P  # noqa: E402

from ssplat_jax.cache import fuse, init_cache, project  # noqa: E402
from ssplat_jax.model.streamsplat import StreamSplat  # noqa: E402
from ssplat_jax.streaming.sharded import ShardedStream  # noqa: E402

jax.config.update("jax_numpy_dtype_promotion", "strict")


def fuse_and_project(config, num_shards, capacity, tokens, camera):
    """The shards after fusing the chunks `tokens` `[t, m, ...]`, and the projection as each of them computed it."""
    mesh = jax.sharding.Mesh(np.array(jax.devices()[:num_shards]), ("voxels",))

    def of_shard(tokens):
        cache = init_cache(config, capacity)
        cache, _ = jax.lax.scan(lambda c, t: (fuse(c, t, config, axis="voxels"), None), cache, tokens)
        projected = project(cache, camera, config, axis="voxels")
        return jax.tree.map(lambda x: x[None], (cache, projected))

    run = jax.shard_map(of_shard, mesh=mesh, in_specs=P(), out_specs=P("voxels"), check_vma=False)
    return everywhere(mesh, jax.jit(run)(on_mesh(mesh, P(), tokens)))


def steps(config, params, chunks, mesh_shape, num_new_tokens=0):
    """Caches and outputs of every step over `chunks` `[t, streams, ...]`, the last scenes, and the grown caches."""
    sharded, mesh = sharded_stream(config, mesh_shape)
    params, step = on_mesh(mesh, P(), params), jax.jit(sharded.step, donate_argnums=1)
    caches, history, outputs = sharded.init_cache(chunks.valid.shape[1]), [], []
    for t in range(len(chunks.valid)):
        chunk = on_mesh(mesh, P("streams"), jax.tree.map(lambda x, t=t: x[t], chunks))
        caches, output = step(params, caches, chunk)
        kept, output = everywhere(mesh, (caches, output))
        history.append(kept)
        outputs.append(output)
    sharded.check(caches)
    grown = sharded.ensure_capacity(caches, num_new_tokens)
    return {
        "caches": history,
        "outputs": outputs,
        "num_compilations": step._cache_size(),
        "gaussians": everywhere(mesh, jax.jit(sharded.decode)(params, caches)),
        "grown": everywhere(mesh, grown),
    }


def scanned(config, params, chunks, mesh_shape):
    """Caches and outputs of one scan over the chunks."""
    sharded, mesh = sharded_stream(config, mesh_shape)
    run = jax.jit(lambda params, *carry_and_chunks: jax.lax.scan(partial(sharded.step, params), *carry_and_chunks))
    caches = sharded.init_cache(chunks.valid.shape[1])
    return everywhere(mesh, run(on_mesh(mesh, P(), params), caches, on_mesh(mesh, P(None, "streams"), chunks)))


def steps_alone(config, params, streams):
    """Caches and outputs of every step and the last scene, of each stream by itself on one device."""
    model, results = StreamSplat(config), []
    step, decode = jax.jit(model.step), jax.jit(model.decode)
    for chunks in streams:
        cache, history, outputs = model.init_cache(), [], []
        for chunk in chunks:
            cache, output = step(params, cache, chunk)
            history.append(cache)
            outputs.append(output)
        results.append((history, outputs, decode(params, cache)))
    return jax.tree.map(np.asarray, results)


def sharded_stream(config, mesh_shape):
    mesh = jax.make_mesh(mesh_shape, ("streams", "voxels"))
    return ShardedStream(StreamSplat(config), mesh), mesh


def on_mesh(mesh, spec, tree):
    """`tree`, which every process has, placed on the devices of the mesh."""
    sharding = NamedSharding(jax.sharding.Mesh(mesh.devices, mesh.axis_names), spec)
    return jax.tree.map(lambda x: jax.make_array_from_callback(x.shape, sharding, lambda part: x[part]), tree)


def everywhere(mesh, tree):
    """The whole arrays, on the host of every process."""
    if jax.process_count() > 1:
        sharding = NamedSharding(jax.sharding.Mesh(mesh.devices, mesh.axis_names), P())
        tree = jax.jit(unchanged, out_shardings=sharding)(tree)
    return jax.tree.map(np.asarray, tree)


def unchanged(tree):
    """The identity; a function of the module, so that it is compiled once."""
    return tree


def main(folder, num_devices, process, num_processes, port):
    jax.config.update("jax_num_cpu_devices", num_devices)
    if num_processes > 1:
        jax.config.update("jax_cpu_collectives_implementation", "gloo")
        jax.distributed.initialize(f"localhost:{port}", num_processes, process)
    jobs = pickle.loads((folder / "jobs.pkl").read_bytes())
    results = {}
    for name, (function_name, arguments) in jobs.items():
        function = globals()[function_name]
        # The network's programs take longer to optimize than to run, so LLVM's optimizations are off.
        jax.config.update("jax_disable_most_optimizations", function is not fuse_and_project)
        results[name] = function(**arguments)
    results["num_devices"] = jax.device_count()
    results["num_processes"] = jax.process_count()
    if process == 0:
        (folder / "results.pkl").write_bytes(pickle.dumps(results))


if __name__ == "__main__":
    main(Path(sys.argv[1]), *(int(x) for x in sys.argv[2:]))
