"""Voxel keys: which cell of a regular grid a point lies in, and a hash of that cell.

A key is the integer triple itself; a hash only says where to look for it and is always verified against the triple.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt32

INDEX_LIMIT = 1 << 20
"""Voxel indices are below this in magnitude: +-42 km at 4 cm, and still exact in float32."""


def voxel_indices(points: Float[Array, "*s 3"], voxel_size: float) -> tuple[Int[Array, "*s 3"], Bool[Array, "*s"]]:
    """Index of the voxel around each point, floor(p / voxel_size), and whether it is in range.

    The division is one multiplication by the float32 reciprocal, rounded the same way on every backend; it is
    monotone, so a point between two points of a voxel is in that voxel, to the last bit.

    Limits:
        |index| >= 2^20 (infinities and NaN included) gives index 0 and False.
    """
    cells = jnp.floor(points * inverse_voxel_size(voxel_size))
    in_range = jnp.all(jnp.abs(cells) < INDEX_LIMIT, axis=-1)
    return jnp.where(in_range[..., None], cells, 0.0).astype(jnp.int32), in_range


def inverse_voxel_size(voxel_size: float) -> float:
    """The float32 number that points are multiplied by."""
    return float(np.float32(1.0 / voxel_size))


def hash_voxels(voxels: Int[Array, "*s 3"]) -> UInt32[Array, "*s"]:
    """32 well-mixed bits of an index triple (multiply-xorshift rounds; the constants are MurmurHash3's finalizer)."""
    x, y, z = (voxels[..., axis].astype(jnp.uint32) for axis in range(3))
    mixed = _mix(x + jnp.uint32(0x9E3779B9))
    mixed = _mix(mixed ^ (y + jnp.uint32(0x7F4A7C15)))
    return _mix(mixed ^ (z + jnp.uint32(0x94D049BB)))


def _mix(bits):
    bits = (bits ^ (bits >> 16)) * jnp.uint32(0x85EBCA6B)
    bits = (bits ^ (bits >> 13)) * jnp.uint32(0xC2B2AE35)
    return bits ^ (bits >> 16)
