"""Voxel indices of points, and the hash table from voxel index to row of the cache.

Voxels come in levels: those of level l have sides of `voxel_size` x 2^l, and eight of them make one of level l + 1. A
token lies in a voxel of the level at which it is between one and two voxels wide, so that near surfaces keep their
detail and far ones take no more space than they show. Without `additions.detail` all voxels are of level 0.

Three indices and the level identify a voxel. Its hash only says where to look for it, by open addressing with linear
probing; a lookup compares all four. Entries are rows, -1 where empty. Single entries are never deleted.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt32

from ssplat_jax.config import StreamConfig
from ssplat_jax.core.numerics import power_of_two

INDEX_LIMIT = 1 << 20  # upper bound of the magnitude of a voxel index: 42 km at 4 cm, and exact in float32
MAX_LEVEL = 16  # levels of voxels lie between plus and minus this

SLOTS_PER_ROW = 4
"""Table slots per cache row. The table is at most a quarter full, so a search ends after a few probes: a cache 90 %
full fuses as fast as one 1 % full."""


def voxel_levels(footprints: Float[Array, "*s"], config: StreamConfig) -> Int[Array, "*s"]:
    """Level of the voxels that hold tokens of these footprints: floor(log2(footprint / voxel_size)).

    Limits:
        Levels end at +-`MAX_LEVEL`. Footprints that are 0, infinite or NaN have some level in that range.
    """
    if not config.additions.detail:
        return jnp.zeros(jnp.shape(footprints), jnp.int32)
    # The exponent is exact, a rounded logarithm would not be.
    _, exponents = jnp.frexp(footprints * float(np.float32(1.0 / config.memory.voxel_size)))
    return jnp.clip(exponents - 1, -MAX_LEVEL, MAX_LEVEL)


def voxel_sides(footprints: Float[Array, "*s"], config: StreamConfig) -> Float[Array, "*s"]:
    """Sides of the voxels that hold tokens or pivots of these footprints, stream units."""
    return jnp.ldexp(jnp.float32(config.memory.voxel_size), voxel_levels(footprints, config))


def voxel_indices(
    points: Float[Array, "*s 3"], footprints: Float[Array, "*s"], config: StreamConfig
) -> tuple[Int[Array, "*s 4"], Bool[Array, "*s"]]:
    """Voxel index of each point, floor(p / side) and the level, and whether it is in range.

    Limits:
        Indices of magnitude 2^20 or more, infinities and NaN give index 0 and False.
    """
    levels = voxel_levels(footprints, config)
    # Multiplied by the float32 reciprocal, which every backend rounds the same way. The product is monotone: a point
    # between two points of a voxel lies in that voxel. `ldexp` rounds nothing (`exp2` does), so that levels nest.
    scale = jnp.ldexp(jnp.float32(1.0 / config.memory.voxel_size), -levels)
    cells = jnp.floor(points * scale[..., None])
    in_range = jnp.all(jnp.abs(cells) < INDEX_LIMIT, axis=-1)
    cells = jnp.where(in_range[..., None], cells, 0.0).astype(jnp.int32)
    return jnp.concatenate([cells, levels[..., None]], axis=-1), in_range


def hash_voxels(voxels: Int[Array, "*s 4"]) -> UInt32[Array, "*s"]:
    """32-bit hashes of voxel indices, mixed by the finalizer of MurmurHash3."""
    x, y, z, level = (voxels[..., axis].astype(jnp.uint32) for axis in range(4))
    mixed = _mix(x + jnp.uint32(0x9E3779B9))
    mixed = _mix(mixed ^ (y + jnp.uint32(0x7F4A7C15)))
    # Indices have 21 bits, so that the level has the highest ones for itself.
    return _mix(mixed ^ ((z ^ (level << 26)) + jnp.uint32(0x94D049BB)))


def _mix(bits):
    bits = (bits ^ (bits >> 16)) * jnp.uint32(0x85EBCA6B)
    bits = (bits ^ (bits >> 13)) * jnp.uint32(0xC2B2AE35)
    return bits ^ (bits >> 16)


def shards_of(voxels: Int[Array, "*s 4"], num_shards: int) -> Int[Array, "*s"]:
    """Number of the cache, of `num_shards` (at most 2^16), that holds each voxel: an even split by hash."""
    # The highest bits, because the hash table uses the lowest: voxels of one shard must still differ in those.
    high_bits = hash_voxels(voxels) >> 16
    return (high_bits * jnp.uint32(num_shards) >> 16).astype(jnp.int32)


def find_rows(
    table: Int[Array, " slots"], voxels: Int[Array, "capacity 4"], wanted: Int[Array, "m 4"], active: Bool[Array, " m"]
) -> Int[Array, " m"]:
    """Rows of the voxels `wanted`; -1 for those that are not stored or not `active`.

    Args:
        table: hash table over the rows.
        voxels: index of the voxel in each row.
        wanted: indices to look up.
        active: which of them to look up.
    """

    def probe(state):
        slots, rows, searching = state
        found = table[slots]
        is_match = jnp.all(voxels[found] == wanted, axis=-1) & (found >= 0)
        rows = jnp.where(searching & is_match, found, rows)
        searching = searching & ~is_match & (found >= 0)
        return (slots + 1) & (table.shape[0] - 1), rows, searching

    start = (_first_slots(table, wanted), jnp.full(wanted.shape[:1], -1, jnp.int32), active)
    return jax.lax.while_loop(lambda state: jnp.any(state[2]), probe, start)[1]


def insert_rows(
    table: Int[Array, " slots"], voxels: Int[Array, "m 4"], rows: Int[Array, " m"], active: Bool[Array, " m"]
) -> Int[Array, " slots"]:
    """`table`, which holds none of the active voxels, with these entered; they must be distinct.

    All voxels claim their slots in parallel; the highest row wins an empty slot, and the others probe on.
    """
    num_slots = table.shape[0]

    def claim(state):
        table, slots, searching = state
        is_free = searching & (table[slots] < 0)
        table = table.at[jnp.where(is_free, slots, num_slots)].max(rows, mode="drop")
        searching = searching & (table[slots] != rows)
        return table, (slots + 1) & (num_slots - 1), searching

    start = (table, _first_slots(table, voxels), active)
    return jax.lax.while_loop(lambda state: jnp.any(state[2]), claim, start)[0]


def build_table(voxels: Int[Array, "capacity 4"], num_voxels: Int[Array, ""]) -> Int[Array, " slots"]:
    """A new hash table of the first `num_voxels` rows."""
    rows = jnp.arange(voxels.shape[0], dtype=jnp.int32)
    empty = jnp.full((SLOTS_PER_ROW * voxels.shape[0],), -1, jnp.int32)
    return insert_rows(empty, voxels, rows, rows < num_voxels)


def group_equal(voxels: Int[Array, "m 4"], active: Bool[Array, " m"]) -> Int[Array, " m"]:
    """For each active voxel the position of the first one equal to it; for the others their own position.

    Uses a temporary hash table of positions. Equal voxels probe in lockstep, so the first of them claims their slot.
    """
    m = voxels.shape[0]
    tokens = jnp.arange(m, dtype=jnp.int32)
    num_slots = power_of_two(SLOTS_PER_ROW * m)

    def claim(state):
        table, slots, leaders, searching = state
        is_free = searching & (table[slots] == m)
        table = table.at[jnp.where(is_free, slots, num_slots)].min(tokens, mode="drop")
        owners = jnp.minimum(table[slots], m - 1)
        is_equal = searching & jnp.all(voxels[owners] == voxels, axis=-1)
        return table, (slots + 1) & (num_slots - 1), jnp.where(is_equal, owners, leaders), searching & ~is_equal

    table = jnp.full((num_slots,), m, jnp.int32)
    start = (table, _first_slots(table, voxels), tokens, active)
    return jax.lax.while_loop(lambda state: jnp.any(state[3]), claim, start)[2]


def _first_slots(table, voxels):
    return (hash_voxels(voxels) & jnp.uint32(table.shape[0] - 1)).astype(jnp.int32)
