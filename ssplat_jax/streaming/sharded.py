"""`ShardedStream`: streams on several devices. One mesh axis splits the streams, the other each stream's cache.

    mesh          voxels ─►                      every device holds an ordinary, smaller cache
    streams   [ device  device  device  device ]   chunk a ─► project ═╗ sums over the row
       ▼      [ device  device  device  device ]   chunk b ─►    "     ╚═► network ─► tokens ─► own ones: fuse, carve

A voxel lies entirely in the shard that its hash selects. Every shard receives all tokens and fuses and counts those of
its own voxels, so nothing moves between caches. Only the projection communicates: it sums over the shards.

Caches are a `VoxelCache` with two leading axes, streams and shards. The stored depths, `stats.num_chunks` and
`stats.num_unusable` are equal on all shards of a stream; the other counters add up.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P
from jaxtyping import PyTree

from ssplat_jax.cache.state import VoxelCache, grow, required_capacity
from ssplat_jax.core.chunk import Chunk
from ssplat_jax.core.errors import InputError, refusal
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.core.pytree import replace
from ssplat_jax.model.streamsplat import ChunkOutput, StreamSplat

AXES = STREAMS, VOXELS = "streams", "voxels"  # axes of the mesh


@dataclasses.dataclass(frozen=True)
class ShardedStream:
    """`model` for several streams over the devices of a mesh. It holds no arrays.

    The voxels axis divides the cache: its memory and the work of `project`, `fuse` and `carve` on it. The network runs
    in full on every device of a stream, so its time does not shrink. A device with several streams runs them one after
    another and copies their caches in every step.

    Args:
        model: the model to run; its config's `capacity` is that of one shard.
        mesh: devices of one process or of several. The axis `streams` splits the streams, `voxels` splits each cache;
            others repeat the work.

    Limits:
        Given the same tokens, a voxel holds the same pivots as in a single cache, to the last bit; only the order of
        the rows differs. The projection adds up in another order, so steps agree with those of one device to float32
        rounding, and a token on the face between two voxels may fall on the other side.
        A full shard drops tokens even if other shards have free rows.

    Raises:
        InputError: `mesh` lacks one of the two axes, or the config asks for refinement while streaming.

    Example:
        >>> mesh = jax.make_mesh((2, 4), ("streams", "voxels"))
        >>> sharded = ShardedStream(model, mesh)
        >>> caches, step = sharded.init_cache(), jax.jit(sharded.step, donate_argnums=1)
        >>> for pair in zip(first.chunks(model.config), second.chunks(model.config)):
        ...     caches = sharded.ensure_capacity(caches, num_new_tokens)
        ...     caches, out = step(params, caches, jax.tree.map(lambda *x: jnp.stack(x), *pair))
        ...     ss.check_cache(caches, model.config)
        >>> gaussians = jax.jit(sharded.decode)(params, caches)
    """

    model: StreamSplat
    mesh: Mesh

    def __post_init__(self) -> None:
        if steps := self.model.config.stream.steps_per_chunk:
            wanted = "stream.steps_per_chunk=0, which only a Session carries out"
            fix = "set it to 0 and refine the finished scene with ss.refine"
            raise refusal("sharded stream", wanted=wanted, got=steps, fix=fix)
        if not set(AXES) <= set(self.mesh.axis_names):
            raise InputError(
                f"sharded stream: the mesh needs the axes {STREAMS} and {VOXELS}, got {self.mesh.axis_names}; give an"
                " axis that you do not use size 1."
            )

    def init_cache(self, num_streams: int | None = None) -> VoxelCache:
        """Empty caches of `num_streams` streams (default: one per row of the mesh), placed on the devices.

        Raises:
            InputError: the streams do not divide evenly over the rows of the mesh.
        """
        rows, shards = (self.mesh.shape[axis] for axis in AXES)
        num_streams = num_streams or rows
        if num_streams % rows:
            raise InputError(f"sharded stream: num_streams must be a multiple of the mesh's {rows}, got {num_streams}.")

        def create() -> VoxelCache:
            return jax.tree.map(lambda x: jnp.broadcast_to(x, (num_streams, shards, *x.shape)), self.model.init_cache())

        return jax.jit(create, out_shardings=NamedSharding(_auto(self.mesh), self._cache_spec))()

    def step(self, params: dict, caches: VoxelCache, chunks: Chunk) -> tuple[VoxelCache, ChunkOutput]:
        """`StreamSplat.step` for one chunk of every stream (leading axis); the caches come first, as a scan's carry."""
        model = dataclasses.replace(self.model, axis=VOXELS)

        def step_stream(params: dict, shard: VoxelCache, chunk: Chunk) -> tuple[VoxelCache, ChunkOutput]:
            cache = _without_axis(shard)
            prediction = model.predict(params, cache, chunk)
            tokens, output = _from_first_shard((prediction.tokens, prediction.output))
            cache = model.update_cache(cache, replace(prediction, tokens=tokens, output=output))
            return jax.tree.map(lambda x: x[None], cache), output

        def step_device(params, shards, chunks):
            return jax.lax.map(lambda x: step_stream(params, *x), (shards, chunks))

        given, results = (P(), self._cache_spec, P(STREAMS)), (self._cache_spec, P(STREAMS))
        return self._map(step_device, given, results)(params, caches, chunks)

    def decode(self, params: dict, caches: VoxelCache) -> Gaussians:
        """The scenes so far, as `StreamSplat.decode`: `[streams, shards * capacity * k]`, shard after shard."""

        def decode_device(params, shards):
            return jax.lax.map(lambda shard: self.model.decode(params, _without_axis(shard)), shards)

        return self._map(decode_device, (P(), self._cache_spec), self._cache_spec)(params, caches)

    def ensure_capacity(self, caches: VoxelCache, num_new_tokens: int) -> VoxelCache:
        """`caches`, all grown alike if any might not hold `num_new_tokens` more; see `cache.ensure_capacity`."""
        wanted = required_capacity(caches, self.model.config, num_new_tokens)
        if wanted == caches.capacity:
            return caches
        grown = self._map(lambda shards: grow(shards, wanted), (self._cache_spec,), self._cache_spec)
        return jax.jit(grown)(caches)

    @property
    def _cache_spec(self) -> P:
        """Partition of the caches over the mesh."""
        # Without axes of size 1, as XLA writes it for results of a step: otherwise `jit` would compile the step again.
        axes = [axis if self.mesh.shape[axis] > 1 else None for axis in AXES]
        while axes and axes[-1] is None:
            axes.pop()
        return P(*axes)

    def _map(self, function: Callable, in_specs: PyTree, out_specs: PyTree) -> Callable[..., Any]:
        """`function`, written for the part on one device, mapped over all devices."""
        # check_vma is off because it takes the constants from which the cache's loops start to be replicated.
        return jax.shard_map(function, mesh=_auto(self.mesh), in_specs=in_specs, out_specs=out_specs, check_vma=False)


def _auto(mesh: Mesh) -> Mesh:
    """`mesh` without the explicit axes of `jax.make_mesh`, which would require arguments already placed."""
    return Mesh(mesh.devices, mesh.axis_names)


def _without_axis(shard: VoxelCache) -> VoxelCache:
    """The cache of a stream on one device, from its block `[1, ...]` of the shards."""
    return jax.tree.map(lambda x: x[0], shard)


def _from_first_shard(tree: PyTree) -> PyTree:
    """The floats of `tree` as computed on the first shard, except for the sign of zeros.

    Devices that round differently would disagree on the voxel of a token and store it in two shards or in none.
    """
    is_first = jax.lax.axis_index(VOXELS) == 0

    def share(x):
        return jax.lax.psum(jnp.where(is_first, x, 0.0), VOXELS) if jnp.issubdtype(x.dtype, jnp.floating) else x

    return jax.tree.map(share, tree)
