"""A process with two devices that steps a sharded stream together with others; started by test_sharded.py.

python -m tests.streaming.sharded_worker FOLDER PROCESS NUM_PROCESSES PORT
"""

import pickle
import sys
from pathlib import Path

import jax
import numpy as np
from jax.sharding import NamedSharding
from jax.sharding import PartitionSpec as P

from ssplat_jax.cache.state import check_cache
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.streaming.sharded import ShardedStream


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
