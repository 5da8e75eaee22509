"""Jobs of `sharded_worker` in processes with several devices, and caches of shards in comparable order."""

import pickle
import socket
import subprocess
import sys

import jax
import numpy as np

from ssplat_jax.cache import PIVOT_FIELDS, VoxelCache

TIMEOUT = 300  # seconds; a run usually takes some ten


class Worker:
    """Starts `jobs` on `num_devices` in each of `num_processes`; `results` waits for them."""

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
        """Results of the jobs, by name."""
        try:
            for process in self.processes:
                log, _ = process.communicate(timeout=TIMEOUT)
                assert process.returncode == 0, log
        finally:
            for process in self.processes:
                process.kill()
        return pickle.loads((self.folder / "results.pkl").read_bytes())


def arrays(tree):
    return jax.tree.map(np.asarray, tree)


def part(tree, *place):
    """`tree` at index `place` of its leading axes."""
    return jax.tree.map(lambda x: x[place], tree)


def each_of(shards):
    """The list of trees that are stacked in `shards`."""
    return [part(shards, i) for i in range(len(jax.tree.leaves(shards)[0]))]


def stacked(trees):
    return jax.tree.map(lambda *x: np.stack(x), *trees)


def sorted_voxels(shards: list[VoxelCache]) -> dict[str, np.ndarray]:
    """Voxels and pivots of all shards, sorted by voxel index."""
    occupied = [slice(0, int(cache.num_voxels)) for cache in shards]
    fields = {
        name: np.concatenate([getattr(cache, name)[rows] for cache, rows in zip(shards, occupied, strict=True)])
        for name in ("voxels", "counts", *PIVOT_FIELDS)
    }
    order = np.lexsort(fields["voxels"].T)
    return {name: x[order] for name, x in fields.items()}


def sorted_pivots(shards: list[VoxelCache]) -> np.ndarray:
    """All fields of each live pivot of all shards, one row per pivot, sorted."""
    alive = np.concatenate([np.asarray(cache.alive) for cache in shards])
    fields = [np.concatenate([getattr(cache, name) for cache in shards])[alive] for name in PIVOT_FIELDS]
    table = np.concatenate([x.reshape(len(x), -1).astype(np.float64) for x in fields], axis=1)
    return table[np.lexsort(table.T)]
