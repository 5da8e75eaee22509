"""VACC, the Voxel-Aligned Causal Cache: the stream's only memory. `fuse` writes, `project` reads, `carve` doubts."""

from ssplat_jax.cache.capacity import check_cache, ensure_room, grow
from ssplat_jax.cache.carve import SAME_SURFACE, bear_witness, carve, judge
from ssplat_jax.cache.fuse import Touched, fuse, fuse_touched
from ssplat_jax.cache.project import ProjectedCache, coarser, project
from ssplat_jax.cache.state import PIVOT_FIELDS, CacheStats, Tokens, VoxelCache, Witnesses, init_cache

__all__ = [
    "PIVOT_FIELDS",
    "SAME_SURFACE",
    "CacheStats",
    "ProjectedCache",
    "Tokens",
    "Touched",
    "VoxelCache",
    "Witnesses",
    "bear_witness",
    "carve",
    "check_cache",
    "coarser",
    "ensure_room",
    "fuse",
    "fuse_touched",
    "grow",
    "init_cache",
    "judge",
    "project",
]
