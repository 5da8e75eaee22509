"""Hash table from voxel index to row: open addressing with linear probing, verified against the stored indices.

Entries are rows, -1 where empty. Single entries are never deleted: a table is rebuilt when rows change their voxels.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from ssplat_jax.cache.voxels import hash_voxels

SLOTS_PER_ROW = 4
"""Table slots per cache row: the table is at most a quarter full, so a search ends after a few probes."""


def find_rows(
    table: Int[Array, " slots"],
    voxels: Int[Array, "capacity 3"],
    wanted: Int[Array, "m 3"],
    active: Bool[Array, " m"],
) -> Int[Array, " m"]:
    """Rows of the voxels `wanted`.

    Args:
        table: hash table over the rows.
        voxels: index of the voxel in each row.
        wanted: indices to look up.
        active: which of them to look up.

    Returns:
        Rows; -1 for voxels that are not stored or not active.
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
    table: Int[Array, " slots"], voxels: Int[Array, "m 3"], rows: Int[Array, " m"], active: Bool[Array, " m"]
) -> Int[Array, " slots"]:
    """`table` with new voxels entered.

    All voxels claim their slots in parallel; the highest row wins an empty slot, and the others probe on.

    Args:
        table: hash table that holds none of the active voxels.
        voxels: indices, distinct where active.
        rows: row of each voxel.
        active: which voxels to enter.

    Returns:
        The hash table.
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


def group_equal(voxels: Int[Array, "m 3"], active: Bool[Array, " m"]) -> Int[Array, " m"]:
    """For each active voxel the position of the first one equal to it; for the others their own position.

    Uses a temporary hash table of positions. Equal voxels probe in lockstep, so the first of them claims their slot.
    """
    m = voxels.shape[0]
    tokens = jnp.arange(m, dtype=jnp.int32)
    num_slots = 1 << (SLOTS_PER_ROW * m - 1).bit_length()

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


def build_table(voxels: Int[Array, "capacity 3"], num_voxels: Int[Array, ""]) -> Int[Array, " slots"]:
    """A new hash table of the first `num_voxels` rows."""
    rows = jnp.arange(voxels.shape[0], dtype=jnp.int32)
    empty = jnp.full((SLOTS_PER_ROW * voxels.shape[0],), -1, jnp.int32)
    return insert_rows(empty, voxels, rows, rows < num_voxels)


def _first_slots(table, voxels):
    return (hash_voxels(voxels) & jnp.uint32(table.shape[0] - 1)).astype(jnp.int32)


def shards_of(voxels: Int[Array, "*s 3"], num_shards: int) -> Int[Array, "*s"]:
    """Number of the cache, of `num_shards`, that holds each voxel: an even split by hash.

    Limits:
        Up to 2^16 shards.
    """
    # The highest bits, because the hash table uses the lowest: voxels of one shard must still differ in those.
    high_bits = hash_voxels(voxels) >> 16
    return (high_bits * jnp.uint32(num_shards) >> 16).astype(jnp.int32)
