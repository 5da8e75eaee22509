"""`ShardedStream`: streams on several devices. One axis of a mesh splits the streams, the other each stream's cache.

    mesh          voxels ─►                      every device holds an ordinary, smaller cache
    streams   [ device  device  device  device ]   chunk a ─► project ═╗ sums over the row
       ▼      [ device  device  device  device ]   chunk b ─►    "     ╚═► network ─► tokens ─► own ones: fuse, carve

A voxel lies whole in the shard that its hash names. Every shard is given all tokens, takes those of its voxels and
counts them, so nothing ever moves between caches; of all stages only the projection, a sum over shards, knows that
there are several.

Caches are a `VoxelCache` with two leading axes, streams and shards. The witnesses and `stats.num_chunks` are the same
on every shard of a stream; the other counters add up.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P
from jaxtyping import PyTree

from ssplat_jax.cache import VoxelCache, grow
from ssplat_jax.cache.capacity import check_dropped, roomy_capacity
from ssplat_jax.chunk import Chunk
from ssplat_jax.errors import InputError
from ssplat_jax.gaussians import Gaussians
from ssplat_jax.pytree import replace
from ssplat_jax.streaming.streamsplat import ChunkOutput, StreamSplat


@dataclasses.dataclass(frozen=True)
class ShardedStream:
    """`model` for several streams over the devices of a mesh. Holds no arrays.

    What the voxels axis divides is the cache: its memory and the work of `project`, `fuse` and `carve` on it. The
    network runs alike on all devices of a stream, and its time does not shrink. A device with several streams takes
    one after another, and copies their caches in every step.

    Args:
        model: what to run; its config's `capacity` is that of one shard.
        mesh: devices of one process or of several. Axes other than the two below repeat the work.
        streams: the axis of `mesh` that splits the streams.
        voxels: the axis of `mesh` that splits each cache.

    Limits:
        Given the same tokens, a voxel holds what it would in one cache, to the last bit; rows come in another order.
        The projection adds up in another order, so a model's steps agree with one device's to float32 rounding, and
        a token that lies on the face between two voxels may come out on the other side.
        A shard that is full drops, or evicts its own lowest voxels, even if its neighbors have room or lower ones.

    Raises:
        InputError: `mesh` lacks one of the two axes.

    Example:
        >>> mesh = jax.make_mesh((2, 4), ("streams", "voxels"))
        >>> sharded = ShardedStream(model, mesh)
        >>> caches, step = sharded.init_cache(), jax.jit(sharded.step, donate_argnums=1)
        >>> for pair in zip(first.chunks(model.config), second.chunks(model.config)):
        ...     caches = sharded.ensure_room(caches, num_new_tokens)
        ...     caches, out = step(params, caches, jax.tree.map(lambda *x: jnp.stack(x), *pair))
        ...     sharded.check(caches)
        >>> gaussians = jax.jit(sharded.decode)(params, caches)
    """

    model: StreamSplat
    mesh: Mesh
    streams: str = "streams"
    voxels: str = "voxels"

    def __post_init__(self) -> None:
        axes = {self.streams, self.voxels}
        if len(axes) < 2 or not axes <= set(self.mesh.axis_names):
            raise InputError(
                f"parallel: the mesh needs an axis for streams and another for voxels, {self.streams!r} and "
                f"{self.voxels!r}, got {self.mesh.axis_names}; one that is not wanted has size 1."
            )

    def init_cache(self, num_streams: int | None = None) -> VoxelCache:
        """Empty caches of `num_streams` streams (default: one per row of the mesh), each on its device.

        Raises:
            InputError: the streams do not divide evenly over the rows of the mesh.
        """
        rows, shards = (self.mesh.shape[axis] for axis in (self.streams, self.voxels))
        num_streams = num_streams or rows
        if num_streams % rows:
            raise InputError(f"parallel: num_streams must be a multiple of the mesh's {rows}, got {num_streams}.")

        def create() -> VoxelCache:
            return jax.tree.map(lambda x: jnp.broadcast_to(x, (num_streams, shards, *x.shape)), self.model.init_cache())

        return jax.jit(create, out_shardings=NamedSharding(self._devices, self._of_shards))()

    def step(self, params: dict, caches: VoxelCache, chunks: Chunk) -> tuple[VoxelCache, ChunkOutput]:
        """One chunk of every stream (leading axis), as `StreamSplat.step`. Carry first, in and out: a scan's body."""
        model = dataclasses.replace(self.model, axis=self.voxels)

        def step_stream(params: dict, cache: VoxelCache, chunk: Chunk) -> tuple[VoxelCache, ChunkOutput]:
            prediction = model.predict(params, cache, chunk)
            tokens, output = _as_on_first_shard((prediction.tokens, prediction.output), self.voxels)
            return model.remember(cache, replace(prediction, tokens=tokens, output=output)), output

        def step_device(params, caches, chunks):
            caches, output = jax.lax.map(lambda x: step_stream(params, *x), (_without_shards(caches), chunks))
            return _with_shards(caches), output

        on_devices = self._map(step_device, (P(), self._of_shards, P(self.streams)), (self._of_shards, P(self.streams)))
        return on_devices(params, caches, chunks)

    def decode(self, params: dict, caches: VoxelCache) -> Gaussians:
        """The scenes so far, as `StreamSplat.decode`: `[streams, shards * capacity * k]`, shard after shard."""

        def decode_device(params, caches):
            return jax.lax.map(functools.partial(self.model.decode, params), _without_shards(caches))

        return self._map(decode_device, (P(), self._of_shards), self._of_shards)(params, caches)

    def ensure_room(self, caches: VoxelCache, num_new_tokens: int) -> VoxelCache:
        """`caches`, all grown alike if one of them might not hold `num_new_tokens` more; see `cache.ensure_room`."""
        config, capacity = self.model.config, caches.voxels.shape[2]
        if config.memory.overflow != "grow":
            return caches
        wanted = roomy_capacity(capacity, int(jnp.max(caches.num_voxels)), num_new_tokens, config)
        if wanted == capacity:
            return caches

        def grow_device(caches):
            grown = jax.lax.map(functools.partial(grow, capacity=wanted), _without_shards(caches))
            return _with_shards(grown)

        return jax.jit(self._map(grow_device, (self._of_shards,), self._of_shards))(caches)

    def check(self, caches: VoxelCache) -> None:
        """Raises if a cache lost something that its policy promises to keep; see `cache.check_cache`.

        Raises:
            CacheError: tokens were dropped for want of room under `overflow` "grow" or "error".
        """
        check_dropped(int(jnp.sum(caches.stats.num_dropped)), caches.voxels.shape[2], self.model.config)

    @property
    def _devices(self) -> Mesh:
        """The mesh without explicit axes, which `jax.make_mesh` gives: they would ask for arguments already placed."""
        return Mesh(self.mesh.devices, self.mesh.axis_names)

    @property
    def _of_shards(self) -> P:
        """How caches lie on the mesh."""
        # Axes of size 1 left out, as XLA does for what a step returns: spelt otherwise, `jit` would compile it again.
        axes = [axis if self.mesh.shape[axis] > 1 else None for axis in (self.streams, self.voxels)]
        while axes and axes[-1] is None:
            axes.pop()
        return P(*axes)

    def _map(self, function: Callable, in_specs: PyTree, out_specs: PyTree) -> Callable[..., Any]:
        """`function` of what lies on one device, for all of them."""
        # Not checked for replication: the cache's loops start from constants, which the check takes to be replicated.
        return jax.shard_map(function, mesh=self._devices, in_specs=in_specs, out_specs=out_specs, check_vma=False)


def _without_shards(caches: VoxelCache) -> VoxelCache:
    """The caches `[streams, ...]` of one device out of its block `[streams, 1, ...]`."""
    return jax.tree.map(lambda x: x[:, 0], caches)


def _with_shards(caches: VoxelCache) -> VoxelCache:
    """A device's block of all caches; undoes `_without_shards`."""
    return jax.tree.map(lambda x: x[:, None], caches)


def _as_on_first_shard(tree: PyTree, axis: str) -> PyTree:
    """The floats of `tree` as the first shard computed them, but for the sign of zeros.

    Devices that round differently would disagree on the voxel of a token, and put it in two shards or in none.
    """
    is_first = jax.lax.axis_index(axis) == 0

    def share(x):
        return jax.lax.psum(jnp.where(is_first, x, 0.0), axis) if jnp.issubdtype(x.dtype, jnp.floating) else x

    return jax.tree.map(share, tree)
