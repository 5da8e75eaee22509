"""VACC, the Voxel-Aligned Causal Cache (Sec. 3.4): `fuse` writes tokens, `project` shows them, `carve` revises."""

from ssplat_jax.cache.fuse import fuse
from ssplat_jax.cache.project import ProjectedCache, coarsen, project, rows_in_sight
from ssplat_jax.cache.state import (
    PIVOT_FIELDS,
    CacheStats,
    StoredDepths,
    Tokens,
    VoxelCache,
    check_cache,
    ensure_capacity,
    grow,
    init_cache,
)
from ssplat_jax.cache.votes import SAME_SURFACE_MARGIN, SeenCells, carve, observe, seen_cells, store_depths, vote

__all__ = [
    "PIVOT_FIELDS",
    "SAME_SURFACE_MARGIN",
    "CacheStats",
    "ProjectedCache",
    "SeenCells",
    "StoredDepths",
    "Tokens",
    "VoxelCache",
    "carve",
    "check_cache",
    "coarsen",
    "ensure_capacity",
    "fuse",
    "grow",
    "init_cache",
    "observe",
    "project",
    "rows_in_sight",
    "seen_cells",
    "store_depths",
    "vote",
]
