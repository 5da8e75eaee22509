"""Voxel indices of points, and hashes of voxel indices.

The index triple identifies a voxel. Its hash only says where to look for it; a lookup compares the triple.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt32

INDEX_LIMIT = 1 << 20
"""Upper bound of the magnitude of a voxel index: 42 km at 4 cm, and exact in float32."""


def voxel_indices(points: Float[Array, "*s 3"], voxel_size: float) -> tuple[Int[Array, "*s 3"], Bool[Array, "*s"]]:
    """Voxel index of each point, floor(p / voxel_size), and whether it is in range.

    Points are multiplied by the float32 reciprocal, which every backend rounds the same way. The product is monotone: a
    point between two points of a voxel lies in that voxel.

    Limits:
        Indices of magnitude 2^20 or more, infinities and NaN give index 0 and False.
    """
    cells = jnp.floor(points * inverse_voxel_size(voxel_size))
    in_range = jnp.all(jnp.abs(cells) < INDEX_LIMIT, axis=-1)
    return jnp.where(in_range[..., None], cells, 0.0).astype(jnp.int32), in_range


def inverse_voxel_size(voxel_size: float) -> float:
    """Float32 reciprocal of `voxel_size`."""
    return float(np.float32(1.0 / voxel_size))


def hash_voxels(voxels: Int[Array, "*s 3"]) -> UInt32[Array, "*s"]:
    """32-bit hashes of voxel indices, mixed by the finalizer of MurmurHash3."""
    x, y, z = (voxels[..., axis].astype(jnp.uint32) for axis in range(3))
    mixed = _mix(x + jnp.uint32(0x9E3779B9))
    mixed = _mix(mixed ^ (y + jnp.uint32(0x7F4A7C15)))
    return _mix(mixed ^ (z + jnp.uint32(0x94D049BB)))


def _mix(bits):
    bits = (bits ^ (bits >> 16)) * jnp.uint32(0x85EBCA6B)
    bits = (bits ^ (bits >> 13)) * jnp.uint32(0xC2B2AE35)
    return bits ^ (bits >> 16)
