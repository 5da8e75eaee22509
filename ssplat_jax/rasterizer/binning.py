"""Tile intersections: the sorted (tile, Gaussian) pairs, front to back within each tile.

Rows are those of a `sorted_table`, from near to far; tiles are numbered camera-major, then row-major. A pair's key is
`tile << bits | row`, so that a sort of plain integers gives the exact order. XLA's CPU backend sorts single integers
five times faster than (key, payload) tuples, hence the packing. Pairs are found from near to far, so pieces of them
that are sorted separately only need to be joined tile by tile (`xla_cpu.sort_pieces`).
"""

import functools

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from ssplat_jax.core.numerics import columns
from ssplat_jax.core.pytree import pytree
from ssplat_jax.core.xla_cpu import SORT_PIECES, by_platform, in_own_kernel, sort_pieces
from ssplat_jax.rasterizer import constants
from ssplat_jax.rasterizer.depth_sorted_table import BOX_COLUMNS, BOX_SIZE, SHAPE_COLUMNS
from ssplat_jax.rasterizer.projection import Splats
from ssplat_jax.rasterizer.tile_grid import Grid, tile_boxes

CAPACITY_SHARES = (17, 20, 24, 28, 32)
"""In 32nds of the capacity, a power of two: the smallest share that holds all pairs is sorted."""

MIN_SHARED_CAPACITY = 1 << 16
"""Below this capacity all of it is sorted, in one piece: every share is a program to compile."""

MAX_PAIRS = (1 << 31) - 1
"""Largest index; counts of pairs stop there."""

READ_AHEAD = 16
"""Entries behind the last pair that may be read."""

KEY_BITS = 32
"""Keys wider than this are sorted as 64-bit integers."""


@pytree
class TileIntersections:
    """For each tile the rows that touch it, front to back: `rows[bounds[t] : bounds[t + 1]]`."""

    rows: Int[Array, " p"]  # the capacity for pairs, and `READ_AHEAD` more
    bounds: Int[Array, " tiles_and_one"]  # pairs whose ellipse misses the tile are left out
    num_pairs: Int[Array, ""]  # needed capacity; pairs above the actual one (the farthest Gaussians) are missing


def count_intersections(splats: Splats, grid: Grid) -> Int[Array, ""]:
    """The capacity that `intersect_tiles` needs; `MAX_PAIRS` stands for that number or more."""
    _, _, width, height = tile_boxes(splats.means2d, splats.radii, grid)
    return _running_sum((width * height).reshape(-1))[-1]


def _running_sum(counts: Int[Array, " m"]) -> Int[Array, " m"]:
    """Inclusive sums that stop at `MAX_PAIRS`, which 20,000 Gaussians over all tiles of a 4k image exceed."""
    with jax.enable_x64(True):
        return jnp.minimum(jnp.cumsum(counts.astype(jnp.int64)), MAX_PAIRS).astype(jnp.int32)


def intersect_tiles(
    table: Float[Array, "m f"], images: Int[Array, " m"], grid: Grid, max_pairs: int
) -> TileIntersections:
    """The sorted tile intersections of a table, at most `max_pairs` of them.

    Args:
        table: from `sorted_table`.
        images: the number of the image in which each row is seen.
        grid: the tiles.
        max_pairs: capacity.

    Returns:
        The intersections; the farthest Gaussians' are missing where the capacity is too small.
    """
    num_rows = table.shape[0]
    width, height = (side.astype(jnp.int32) for side in columns(table[:, BOX_SIZE]))
    ends = _running_sum(width * height)

    def sorted_pairs(capacity: int):
        rows = _owners(ends, capacity)
        tiles = _tiles(table, images, ends, rows, grid)
        in_pieces = lambda pieces: lambda: _sort_pairs(tiles, rows, grid.num_tiles, num_rows, pieces)  # noqa: E731
        pieces = SORT_PIECES if capacity >= MIN_SHARED_CAPACITY else 1
        rows, bounds = by_platform(cpu=in_pieces(pieces), other=in_pieces(1))
        return jnp.pad(rows, (0, max_pairs - capacity + READ_AHEAD)), bounds

    shares = CAPACITY_SHARES if max_pairs >= MIN_SHARED_CAPACITY else CAPACITY_SHARES[-1:]
    capacities = sorted({-(-max_pairs * share // 32) for share in shares})
    smallest = jnp.sum(ends[-1] > jnp.array(capacities[:-1], jnp.int32), dtype=jnp.int32)
    rows, bounds = lax.switch(smallest, [functools.partial(sorted_pairs, capacity) for capacity in capacities])
    return TileIntersections(rows=rows, bounds=bounds, num_pairs=ends[-1])


def _tiles(table, images: Int[Array, " m"], ends: Int[Array, " m"], rows: Int[Array, " p"], grid: Grid):
    """The tile of every pair `[p]`; `grid.num_tiles` where there is none or the Gaussian's ellipse misses it.

    Pairs of one row are consecutive, so the table is read from one end to the other.
    """

    def tiles_of():
        pair = jnp.arange(rows.shape[0], dtype=jnp.int32)
        # One column at a time: together, they would be copied for every pair.
        read = lambda columns: [table.at[rows, i].get(mode="promise_in_bounds") for i in columns]  # noqa: E731
        (x, y, *factors, logs), box = read(SHAPE_COLUMNS), read(BOX_COLUMNS)
        left, top, width, height = (side.astype(jnp.int32) for side in box)
        place = pair - (ends[rows] - width * height)
        down = place // jnp.maximum(width, 1)
        column, line = left + place - down * width, top + down
        low = [(side * grid.tile).astype(x.dtype) + 0.5 - mean for side, mean in ((column, x), (line, y))]
        reached = _reaches(low, (*factors, logs - constants.LOG_ALPHA_MIN), grid.tile) & (pair < ends[-1])
        tiles = (images[rows] * grid.rows + line) * grid.columns + column
        return jnp.where(reached, tiles, grid.num_tiles)

    return in_own_kernel(ends[-1] >= 0, tiles_of)  # always true, which the compiler does not know


def _reaches(low, shape, tile: int):
    """True if a Gaussian's ellipse of alpha = 1/255 reaches the pixel centers of a tile: a quarter of a box's do not.

    The least exponent over the tile is on an edge that faces the mean (or is 0 inside). The rounding error of float32,
    which is large for needles, is subtracted, so that no pair is missed.
    """
    (low_x, low_y), (p, q, r, bound) = low, shape
    high_x, high_y = low_x + (tile - 1), low_y + (tile - 1)
    near_x, near_y = jnp.clip(0.0, low_x, high_x), jnp.clip(0.0, low_y, high_y)
    along_x = jnp.clip(-q * near_y / jnp.maximum(p, 1e-15), low_x, high_x)
    along_y = jnp.clip(-p * q * near_x / jnp.maximum(q * q + r * r, 1e-30), low_y, high_y)

    def least(dx, dy):
        across, lost = jnp.abs(p * dx + q * dy), 1e-6 * (jnp.abs(p * dx) + jnp.abs(q * dy))
        return jnp.maximum(across - lost, 0.0) ** 2 + (r * dy) ** 2

    return jnp.minimum(least(near_x, along_y), least(along_x, near_y)) <= bound * 1.0001 + 1e-4


def _owners(ends: Int[Array, " m"], capacity: int) -> Int[Array, " p"]:
    """The run that each position belongs to, of consecutive runs that end (exclusively) at `ends`."""
    steps = jnp.zeros((capacity,), jnp.int32).at[ends].add(1, mode="drop")
    return jnp.minimum(jnp.cumsum(steps), ends.shape[0] - 1)


def _sort_pairs(
    tiles: Int[Array, " p"], rows: Int[Array, " p"], num_tiles: int, num_rows: int, pieces: int
) -> tuple[Int[Array, " p"], Int[Array, " tiles_and_one"]]:
    """Rows in order of (tile, row), and where each tile's rows begin.

    Args:
        tiles: the tile of each pair; `num_tiles` for those to leave out.
        rows: the row of each pair, in ascending order with no row left out.
        num_tiles: number of tiles.
        num_rows: number of rows of the table.
        pieces: number of arrays to sort side by side.

    Returns:
        The sorted rows, and bounds as in `TileIntersections`. Inside a piece, rows are counted from its first: that
        takes fewer bits, so that most keys fit in 32.
    """
    capacity = tiles.shape[0]
    size = -(-capacity // pieces)
    padding = (0, pieces * size - capacity)
    max_row = min(size, num_rows) - 1
    bits = max(1, max_row.bit_length())
    fits = num_tiles.bit_length() + bits <= KEY_BITS
    rows = jnp.pad(rows, padding).reshape(pieces, size)
    tiles = jnp.pad(tiles, padding, constant_values=num_tiles).reshape(pieces, size)
    first = rows[:, :1]
    with jax.enable_x64(not fits):
        dtype = jnp.uint32 if fits else jnp.uint64
        shift = jnp.array(bits, dtype)
        keys = (tiles.astype(dtype) << shift) | jnp.clip(rows - first, 0, max_row).astype(dtype)
        keys = sort_pieces(keys)
        starts = jnp.arange(num_tiles + 1, dtype=dtype) << shift
        bounds = jax.vmap(lambda piece: jnp.searchsorted(piece, starts))(keys).astype(jnp.int32)
        tiles = (keys >> shift).astype(jnp.int32)
        rows = (keys & ((jnp.array(1, dtype) << shift) - jnp.array(1, dtype))).astype(jnp.int32)
    rows = jnp.minimum(rows + first, num_rows - 1)
    return (rows[0], bounds[0]) if pieces == 1 else _join(tiles, rows, bounds, capacity)


def _join(tiles: Int[Array, "s n"], rows: Int[Array, "s n"], bounds: Int[Array, "s tiles_and_one"], capacity: int):
    """The rows of sorted pieces, piece after piece within each tile, and where each tile's rows begin."""
    num_pieces, size = tiles.shape
    counts = jnp.diff(bounds, axis=1, append=size)
    begins = jnp.sum(bounds, axis=0)  # a tile begins behind all that stands before it in any piece
    moves = begins + jnp.cumsum(counts, axis=0) - counts - bounds  # of a piece's rows for a tile
    numbers = jnp.arange(num_pieces, dtype=jnp.int32)[:, None] * bounds.shape[1] + tiles
    places = (moves.reshape(-1)[numbers] + jnp.arange(size, dtype=jnp.int32)).reshape(-1)
    return jnp.zeros_like(places).at[places].set(rows.reshape(-1), unique_indices=True)[:capacity], begins
