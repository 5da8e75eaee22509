"""Pivots that a view shows, found without rendering: those before which little of their grid cell is covered.

A view of a large scene has many more pivots in its frustum than it shows. Those behind surfaces would cost a step as
much as those that it revises.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ssplat_jax.cache.key_views import KeyViews
from ssplat_jax.cache.project import NEAR
from ssplat_jax.cache.state import VoxelCache
from ssplat_jax.config import StreamConfig
from ssplat_jax.model.decoder import grown_footprints
from ssplat_jax.model.streamsplat import shown_pivots
from ssplat_jax.model.views import GRID_STRIDE

PIVOTS_PER_CELL = 8
"""Pivots that a step revises, as a multiple of the grid cells of its view: the least covered ones. It fixes time and
memory of a step."""

LISTED_PER_CELL = 64
"""Most pivots of a view that are compared, as a multiple of its grid cells; beyond it, the last rows are left out."""


def visible_pivots(cache: VoxelCache, view: KeyViews, config: StreamConfig) -> Int[Array, " m"]:
    """Shown pivots in a view, the least covered ones if there are more than there is space for.

    A pivot is covered by the area of the pivots before it in its cell: their squared footprints, at most one cell each.
    Where that is 3 cells, about a twentieth of the light is left.

    Args:
        cache: the scene.
        view: one view, without a batch axis; one that is not valid sees nothing.
        config: `min_confidence` decides which pivots are shown.

    Returns:
        Numbers of pivots, row by row, from the least covered one; -1 after the last.
    """
    height, width = view.images.shape[:2]
    rows, columns = -(-height // GRID_STRIDE), -(-width // GRID_STRIDE)
    num_cells = rows * columns
    points = cache.means.reshape(-1, 3).T
    x, y, z = (r[0] * points[0] + r[1] * points[1] + r[2] * points[2] + r[3] for r in view.viewmats[:3])
    column, row = ((view.Ks[i, i] * along / z + view.Ks[i, 2]) / GRID_STRIDE for i, along in enumerate((x, y)))
    is_seen = view.valid & shown_pivots(cache, config).reshape(-1) & (z > NEAR)
    is_seen &= (column > -1) & (column < columns + 1) & (row > -1) & (row < rows + 1)

    num_pivots = is_seen.shape[0]
    size = min(LISTED_PER_CELL * num_cells, num_pivots)
    listed = jnp.nonzero(is_seen, size=size, fill_value=num_pivots)[0].astype(jnp.int32)
    is_listed, taken = listed < num_pivots, jnp.minimum(listed, num_pivots - 1)
    cell_of = lambda place, count: jnp.clip(place[taken], 0, count - 1).astype(jnp.int32)  # noqa: E731
    cells = jnp.where(is_listed, cell_of(row, rows) * columns + cell_of(column, columns), num_cells)
    stored, num_members = (x.reshape(-1)[taken] for x in (cache.footprints, cache.num_members))
    sides = grown_footprints(stored, num_members, config) * view.Ks[0, 0] / (z[taken] * GRID_STRIDE)
    covers = areas_before(cells, z[taken], jnp.where(is_listed, jnp.minimum(sides * sides, 1.0), 0.0), num_cells)

    order = _argsort(jnp.where(is_listed, covers, jnp.inf))[: min(PIVOTS_PER_CELL * num_cells, size)]
    return jnp.where(is_listed[order], listed[order], -1)


def areas_before(
    cells: Int[Array, " n"], depths: Float[Array, " n"], areas: Float[Array, " n"], num_cells: int
) -> Float[Array, " n"]:
    """For each entry the summed areas of the nearer entries of its cell.

    Args:
        cells: 0 to `num_cells`.
        depths: positive. Nearly equal ones count in the order of the entries: 64 bits hold cell, depth and entry, which
            leaves the depth all its 32 bits, or 31 at a million entries in 4,800 cells.
        areas: of each entry.
        num_cells: number of cells.
    """
    slot_bits, cell_bits = len(cells).bit_length(), num_cells.bit_length()
    depth_bits = min(32, 64 - slot_bits - cell_bits)
    with jax.enable_x64(
        True
    ):  # one integer holds cell, depth and entry: XLA's CPU backend sorts it seven times as fast
        slots = jnp.arange(len(cells), dtype=jnp.uint64)
        depths_first = _bits(depths) >> jnp.uint64(32 - depth_bits)
        keys = (cells.astype(jnp.uint64) << jnp.uint64(depth_bits)) | depths_first
        keys = jnp.sort((keys << jnp.uint64(slot_bits)) | slots)
        order = (keys & jnp.uint64((1 << slot_bits) - 1)).astype(jnp.int32)
    own, cell = areas[order], cells[order]
    before = jnp.cumsum(own) - own
    begins = jax.lax.cummax(jnp.where(jnp.append(True, cell[1:] != cell[:-1]), before, 0.0))
    return jnp.zeros_like(areas).at[order].set(jnp.maximum(before - begins, 0.0), unique_indices=True)


def _argsort(values: Float[Array, " n"]) -> Int[Array, " n"]:
    """The order of values that are not negative."""
    with jax.enable_x64(True):
        keys = jnp.sort((_bits(values) << jnp.uint64(32)) | jnp.arange(len(values), dtype=jnp.uint64))
        return (keys & jnp.uint64(0xFFFFFFFF)).astype(jnp.int32)


def _bits(values: Float[Array, " n"]) -> Array:
    """Integers in the order of values that are not negative."""
    return jax.lax.bitcast_convert_type(values, jnp.uint32).astype(jnp.uint64)
