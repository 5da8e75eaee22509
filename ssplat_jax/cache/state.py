"""`VoxelCache`: the stream's only memory, a pure pytree of fixed size (Sec. 3.4, VACC)."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ssplat_jax.cache.hash_table import SLOTS_PER_ROW
from ssplat_jax.config import StreamConfig
from ssplat_jax.errors import InputError
from ssplat_jax.pytree import pytree


def add_to(counter: Int[Array, ""], more: Int[Array, ""]) -> Int[Array, ""]:
    """`counter + more`, both not negative, that stops at the largest integer instead of turning negative."""
    return counter + jnp.minimum(more, jnp.iinfo(counter.dtype).max - counter)


@pytree
class CacheStats:
    """Counters over the whole stream: what only the running program knows. Read them outside jit; `check_cache` does.

    They stop at 2^31 - 1 (`add_to`): tokens of 4 views at 1080p are that many after 4000 chunks.
    """

    num_chunks: Int[Array, ""]
    num_seen: Int[Array, ""]  # tokens of valid views offered to the cache
    num_accepted: Int[Array, ""]  # appended or merged
    num_merged: Int[Array, ""]  # merges done (each leaves the number of pivots as it was)
    num_low_confidence: Int[Array, ""]  # rejected: below tau_conf, as they came or once judged
    num_non_finite: Int[Array, ""]  # rejected: NaN or infinite
    num_out_of_range: Int[Array, ""]  # rejected: voxel index beyond +-2^20
    num_dropped: Int[Array, ""]  # rejected: no room for a new voxel (overflow)
    num_evicted: Int[Array, ""]  # pivots lost to overflow="evict_lowest"


@pytree
class Witnesses:
    """The views of `w` chunks, coarsely: what they looked through and saw, kept to judge what later chunks claim.

    A ring: chunk `n` writes entry `n % w`. A cell holds the nearest surface that its part of the view saw, if all of
    that part was trusted.
    """

    viewmats: Float[Array, "w 4 4"]
    Ks: Float[Array, "w 3 3"]  # in units of the coarse cells
    log_depths: Float[Array, "w g g"]
    weights: Float[Array, "w g g"]  # least confidence in the cell; 0 where it is no witness


@pytree
class VoxelCache:
    """Up to `capacity` voxels of up to `k` pivots each.

    Rows are dense: voxels 0 .. num_voxels-1 are occupied, in order of their first token; in a row the first
    `counts` pivots are alive. `table` is an open-addressing hash from voxel index to row, verified against `voxels`.
    Dead pivots hold zeros.
    """

    # which voxels there are
    voxels: Int[Array, "capacity 3"]  # floor(mean / voxel_size)
    counts: Int[Array, " capacity"]  # alive pivots, 0 .. k
    num_voxels: Int[Array, ""]
    table: Int[Array, " slots"]  # row of the voxel hashed here, -1 where empty (table.py)
    # their pivots
    means: Float[Array, "capacity k 3"]  # stream frame
    feats: Float[Array, "capacity k c"]  # the token state f
    seeds: Float[Array, "capacity k c"]  # feature of the most confident member, for matching
    confidences: Float[Array, "capacity k"]  # omega, (0, 1]
    rgbs: Float[Array, "capacity k a"]  # appearance anchor: mean colors of the parts of the token's patch
    quats: Float[Array, "capacity k 4"]  # camera-to-world orientation of the most confident member, wxyz
    footprints: Float[Array, "capacity k"]  # size of a grid cell at the most confident member, stream units
    num_members: Int[Array, "capacity k"]  # tokens merged into the pivot
    last_chunks: Int[Array, "capacity k"]  # chunk that last wrote it
    witnesses: Witnesses
    stats: CacheStats

    @property
    def alive(self) -> Bool[Array, "capacity k"]:
        """Which pivots exist."""
        return jnp.arange(self.means.shape[1]) < self.counts[:, None]

    @property
    def capacity(self) -> int:
        """Voxels it can hold."""
        return self.voxels.shape[0]


PIVOT_FIELDS = (
    "means",
    "feats",
    "seeds",
    "confidences",
    "rgbs",
    "quats",
    "footprints",
    "num_members",
    "last_chunks",
)
"""The fields of `VoxelCache` that hold one entry per pivot, `[capacity, k, ...]`."""


@pytree
class Tokens:
    """`m` tokens on their way into the cache, in order of insertion (view-major, row-major)."""

    means: Float[Array, "m 3"]
    feats: Float[Array, "m c"]
    confidences: Float[Array, " m"]
    rgbs: Float[Array, "m a"]  # 3 of each of its Gaussians, row by row over the cell
    quats: Float[Array, "m 4"]  # orientation of the camera that saw the token, camera-to-world, wxyz
    footprints: Float[Array, " m"]
    valid: Bool[Array, " m"]  # False: padding; neither used nor counted


WITNESS_CELLS = 32
"""Cells of a witness along each side of its view."""


def init_witnesses(config: StreamConfig) -> Witnesses:
    """Room for the config's witnesses (none without carving); they have seen nothing yet."""
    w = config.memory.num_witnesses if config.memory.carving else 0
    cells = (w, WITNESS_CELLS, WITNESS_CELLS)
    return Witnesses(
        viewmats=jnp.zeros((w, 4, 4)),
        Ks=jnp.zeros((w, 3, 3)),
        log_depths=jnp.zeros(cells),
        weights=jnp.zeros(cells),
    )


def require_one(cache: VoxelCache, caller: str) -> None:
    """Refuses caches with leading axes, of streams or shards, where `caller` takes one.

    Raises:
        InputError: there are several.
    """
    if shape := cache.num_voxels.shape:
        raise InputError(
            f"{caller}: wanted the cache of one stream on one device, got caches of shape {list(shape)}; take one at a"
            f" time, jax.tree.map(lambda x: x[{', '.join('0' * len(shape))}], caches)."
        )


def init_cache(config: StreamConfig, capacity: int | None = None) -> VoxelCache:
    """An empty cache of `capacity` voxels (default: the config's).

    Raises:
        InputError: `capacity` is no power of two, which the hash table's masks need.
    """
    capacity = config.memory.capacity if capacity is None else capacity
    if capacity < 1 or capacity & (capacity - 1):
        raise InputError(f"cache: capacity must be a power of two, got {capacity}.")
    k, c = config.memory.pivots_per_voxel, config.network.token_width
    zero = lambda: jnp.zeros((), jnp.int32)  # noqa: E731 - one fresh buffer per counter, so that all can be donated
    return VoxelCache(
        voxels=jnp.zeros((capacity, 3), jnp.int32),
        counts=jnp.zeros((capacity,), jnp.int32),
        num_voxels=zero(),
        table=jnp.full((SLOTS_PER_ROW * capacity,), -1, jnp.int32),
        means=jnp.zeros((capacity, k, 3)),
        feats=jnp.zeros((capacity, k, c)),
        seeds=jnp.zeros((capacity, k, c)),
        confidences=jnp.zeros((capacity, k)),
        rgbs=jnp.zeros((capacity, k, 3 * config.head.gaussians_per_token)),
        quats=jnp.zeros((capacity, k, 4)),
        footprints=jnp.zeros((capacity, k)),
        num_members=jnp.zeros((capacity, k), jnp.int32),
        last_chunks=jnp.zeros((capacity, k), jnp.int32),
        witnesses=init_witnesses(config),
        stats=CacheStats(*(zero() for _ in range(9))),
    )
