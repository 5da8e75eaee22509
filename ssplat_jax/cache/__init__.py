"""VACC, the Voxel-Aligned Causal Cache (Sec. 3.4): `fuse` writes tokens, `project` reads views, `carve` revises."""

from ssplat_jax.cache.capacity import check_cache, ensure_capacity, grow
from ssplat_jax.cache.carve import SAME_SURFACE_MARGIN, carve, judge, store_witness
from ssplat_jax.cache.fuse import fuse
from ssplat_jax.cache.project import ProjectedCache, coarsen, project
from ssplat_jax.cache.sightings import add_sightings
from ssplat_jax.cache.state import PIVOT_FIELDS, CacheStats, Tokens, VoxelCache, Witnesses, init_cache

__all__ = [
    "PIVOT_FIELDS",
    "SAME_SURFACE_MARGIN",
    "CacheStats",
    "ProjectedCache",
    "Tokens",
    "VoxelCache",
    "Witnesses",
    "add_sightings",
    "carve",
    "check_cache",
    "coarsen",
    "ensure_capacity",
    "fuse",
    "grow",
    "init_cache",
    "judge",
    "project",
    "store_witness",
]
