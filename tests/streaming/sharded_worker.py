"""A process of a sharded run, with devices of its own, that works together with others.

    python -m tests.streaming.sharded_worker FOLDER NUM_DEVICES PROCESS NUM_PROCESSES PORT

Runs the jobs in FOLDER/jobs.pkl, functions of this file by name; process 0 writes the results to FOLDER/results.pkl.
"""

import pickle
import sys
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


def fuse_and_project(config, capacity, tokens, camera):
    """The shards after fusing the chunks `tokens` `[t, m, ...]`, and the projection as each of them computed it."""
    mesh = jax.sharding.Mesh(np.array(jax.devices()), ("voxels",))

    def of_shard(tokens):
        cache = init_cache(config, capacity)
        cache, _ = jax.lax.scan(lambda c, t: (fuse(c, t, config, axis="voxels"), None), cache, tokens)
        projected = project(cache, camera, config, axis="voxels")
        return jax.tree.map(lambda x: x[None], (cache, projected))

    run = jax.shard_map(of_shard, mesh=mesh, in_specs=P(), out_specs=P("voxels"), check_vma=False)
    return everywhere(mesh, jax.jit(run)(on_mesh(mesh, P(), tokens)))


def steps(config, params, chunks, num_new_tokens):
    """Caches and outputs of every step over `chunks` `[t, streams, ...]`, the last scenes, and the grown caches."""
    mesh = jax.make_mesh((2, 2), ("streams", "voxels"))
    sharded = ShardedStream(StreamSplat(config), mesh)
    params, step = on_mesh(mesh, P(), params), jax.jit(sharded.step, donate_argnums=1)
    caches, history = sharded.init_cache(chunks.valid.shape[1]), []
    for t in range(len(chunks.valid)):
        caches, output = step(params, caches, on_mesh(mesh, P("streams"), jax.tree.map(lambda x, t=t: x[t], chunks)))
        history.append(everywhere(mesh, (caches, output)))
    sharded.check(caches)
    grown = sharded.ensure_capacity(caches, num_new_tokens)
    scenes = jax.jit(sharded.decode)(params, caches)
    return history, step._cache_size(), *everywhere(mesh, (scenes, grown))


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


def main(folder, num_devices, process, num_processes, port):
    jax.config.update("jax_num_cpu_devices", num_devices)
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    jax.distributed.initialize(f"localhost:{port}", num_processes, process)
    jobs = pickle.loads((folder / "jobs.pkl").read_bytes())
    results = {}
    for name, arguments in jobs.items():
        # The network's programs take longer to optimize than to run, so LLVM's optimizations are off.
        jax.config.update("jax_disable_most_optimizations", name == "steps")
        results[name] = globals()[name](**arguments)
    if process == 0:
        (folder / "results.pkl").write_bytes(pickle.dumps(results | {"devices": jax.device_count()}))


if __name__ == "__main__":
    main(Path(sys.argv[1]), *(int(x) for x in sys.argv[2:]))
