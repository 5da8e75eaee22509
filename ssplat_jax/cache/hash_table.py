"""The open-addressing hash from voxel index to row: linear probing, verified against the stored triples.

Entries are rows, -1 where empty, and never removed one by one: a table is rebuilt when rows change hands. It has four
slots per row, so it is at most a quarter full and a search ends after a few probes, whatever the cache holds.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from ssplat_jax.geometry.voxels import hash_voxels

SLOTS_PER_ROW = 4


def find_rows(
    table: Int[Array, " slots"],
    voxels: Int[Array, "capacity 3"],
    wanted: Int[Array, "m 3"],
    active: Bool[Array, " m"],
) -> Int[Array, " m"]:
    """Rows of the voxels `wanted`, -1 for those not held and those not `active`."""

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
    """Enters the `active` ones of distinct `voxels` that are not held yet.

    All claim their slot at once; of several claims on one empty slot the highest row wins, and the others go on.
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
    """For each of the `active` voxels the index of the first one equal to it; its own index for the others.

    A table of its own, of tokens instead of rows. Equal voxels search in step, so the lowest of them claims their slot.
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
    """A fresh table of the first `num_voxels` rows."""
    rows = jnp.arange(voxels.shape[0], dtype=jnp.int32)
    empty = jnp.full((SLOTS_PER_ROW * voxels.shape[0],), -1, jnp.int32)
    return insert_rows(empty, voxels, rows, rows < num_voxels)


def _first_slots(table, voxels):
    return (hash_voxels(voxels) & jnp.uint32(table.shape[0] - 1)).astype(jnp.int32)


def shards_of(voxels: Int[Array, "*s 3"], num_shards: int) -> Int[Array, "*s"]:
    """Which of `num_shards` caches holds each voxel, evenly by hash.

    Limits:
        Up to 2^16 shards.
    """
    # The highest bits: a table searches from the lowest, and a shard's voxels must not share those.
    high_bits = hash_voxels(voxels) >> 16
    return (high_bits * jnp.uint32(num_shards) >> 16).astype(jnp.int32)
