"""Which Gaussians touch which tile, front to back: sorted (tile, Gaussian) pairs.

Rows are those of a `sorted_table`, from near to far; tiles are numbered camera-major, row-major. A pair's key is
`tile << bits | row`, so that a sort of plain integers puts everything in exact order. XLA sorts single integers five
times faster than (key, payload) tuples, hence the packing. Pairs are found from near to far, so that pieces of them,
sorted each by itself, need only be laid one after the other within each tile: XLA's CPU runtime sorts the pieces on all
cores, a single array on one.
"""

import functools

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from ssplat_jax.numerics import columns
from ssplat_jax.pytree import pytree
from ssplat_jax.rasterizer import constants
from ssplat_jax.rasterizer.depth_sorted_table import BOX, SHAPE
from ssplat_jax.rasterizer.projection import Splats
from ssplat_jax.rasterizer.tile_grid import Grid, tile_boxes
from ssplat_jax.xla_cpu import apart

# In 32nds, of the room for pairs (a power of two): the least share that holds them is what is sorted.
SHARES = (17, 20, 24, 28, 32)
WORTH_CHOOSING = 1 << 16  # room for pairs below which all of it is sorted: each share is compiled by itself
PIECES = 16  # sorted by themselves where room is chosen; the CPU runtime shares out what waits from nine at a time on
MOST_PAIRS = (1 << 31) - 1  # what an index reaches; counts of pairs stop there
READ_AHEAD = 8  # places behind the last pair that may be read
KEY_BITS = 32  # keys wider than this are sorted as 64-bit integers


@pytree
class Pairs:
    """For each tile the rows that touch it, front to back: `rows[bounds[t] : bounds[t + 1]]`."""

    rows: Int[Array, " p"]  # room for pairs, and `READ_AHEAD` more
    bounds: Int[Array, " tiles_and_one"]  # pairs whose ellipse misses the tile are left out
    num_pairs: Int[Array, ""]  # needed; those beyond the room (the farthest Gaussians) are missing


def count_pairs(splats: Splats, grid: Grid) -> Int[Array, ""]:
    """Pairs that `bin_rows` needs room for; `MOST_PAIRS` stands for any number from there on."""
    _, _, width, height = tile_boxes(splats.means2d, splats.extents, grid)
    return _running_sum((width * height).reshape(-1))[-1]


def _running_sum(counts: Int[Array, " m"]) -> Int[Array, " m"]:
    """Inclusive sums that stop at `MOST_PAIRS`: 20,000 Gaussians before all tiles of a 4k image already pass it."""
    with jax.enable_x64(True):
        return jnp.minimum(jnp.cumsum(counts.astype(jnp.int64)), MOST_PAIRS).astype(jnp.int32)


def bin_rows(table: Float[Array, "m f"], images: Int[Array, " m"], grid: Grid, max_pairs: int) -> Pairs:
    """The sorted pairs of tiles and the rows of a table (from near to far), at most `max_pairs` of them.

    Args:
        table: as `sorted_table` makes it.
        images: which image each row is seen in.
        grid: the tiles.
        max_pairs: room for pairs.
    """
    num_rows = table.shape[0]
    width, height = (side.astype(jnp.int32) for side in columns(table[:, -2:]))
    ends = _running_sum(width * height)

    def sorted_pairs(room: int):
        rows = _owners(ends, room)
        rows, bounds = _sort_pairs(_tiles(table, images, ends, rows, grid), rows, grid.num_tiles, num_rows)
        return jnp.pad(rows, (0, max_pairs - room + READ_AHEAD)), bounds

    shares = SHARES if max_pairs >= WORTH_CHOOSING else SHARES[-1:]
    rooms = sorted({-(-max_pairs * share // 32) for share in shares})
    enough = jnp.sum(ends[-1] > jnp.array(rooms[:-1], jnp.int32), dtype=jnp.int32)
    rows, bounds = lax.switch(enough, [functools.partial(sorted_pairs, room) for room in rooms])
    return Pairs(rows=rows, bounds=bounds, num_pairs=ends[-1])


def _tiles(table, images: Int[Array, " m"], ends: Int[Array, " m"], rows: Int[Array, " p"], grid: Grid):
    """The tile of every pair `[p]`; `grid.num_tiles` where there is none, or one that the Gaussian's ellipse misses.

    Pairs of one row stand together, so that the table is read from one end to the other.
    """

    def tiles_of():
        pair = jnp.arange(rows.shape[0], dtype=jnp.int32)
        # One column at a time: together, they would be copied for every pair.
        read = [table.at[rows, i].get(mode="promise_in_bounds") for i in (*range(SHAPE), *range(-BOX, 0))]
        x, y, *factors, logs = read[:SHAPE]
        left, top, width, height = (side.astype(jnp.int32) for side in read[SHAPE:])
        place = pair - (ends[rows] - width * height)
        down = place // jnp.maximum(width, 1)
        column, line = left + place - down * width, top + down
        low = [(side * grid.tile).astype(x.dtype) + 0.5 - mean for side, mean in ((column, x), (line, y))]
        reached = _reaches(low, (*factors, logs - constants.LOG_ALPHA_MIN), grid.tile) & (pair < ends[-1])
        tiles = (images[rows] * grid.rows + line) * grid.columns + column
        return jnp.where(reached, tiles, grid.num_tiles)

    return apart(ends[-1] >= 0, tiles_of)  # always, which the compiler does not know


def _reaches(low, shape, tile: int):
    """Whether a Gaussian's ellipse of alpha = 1/255 reaches the pixel centers of a tile: a quarter of a box's do not.

    The least exponent over the tile lies on an edge that faces the mean (or is 0 inside); what float32 may lose of it,
    for needles, is given back, so that no pair is missed.
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


def _owners(ends: Int[Array, " m"], max_pairs: int) -> Int[Array, " p"]:
    """Which of consecutive runs that end (exclusively) at `ends` each position belongs to."""
    steps = jnp.zeros((max_pairs,), jnp.int32).at[ends].add(1, mode="drop")
    return jnp.minimum(jnp.cumsum(steps), ends.shape[0] - 1)


def _sort_pairs(
    tiles: Int[Array, " p"], rows: Int[Array, " p"], num_tiles: int, num_rows: int
) -> tuple[Int[Array, " p"], Int[Array, " tiles_and_one"]]:
    """Rows in order of (tile, row), and where each tile's begin, of pairs in order of row that leave out none.

    A piece's rows are counted from its first: fewer bits, so that most keys keep to 32 of them.
    """
    room = tiles.shape[0]
    pieces = PIECES if room >= WORTH_CHOOSING else 1
    size = -(-room // pieces)
    padding = (0, pieces * size - room)
    most = min(size, num_rows) - 1
    bits = max(1, most.bit_length())
    fits = num_tiles.bit_length() + bits <= KEY_BITS
    rows = jnp.pad(rows, padding).reshape(pieces, size)
    tiles = jnp.pad(tiles, padding, constant_values=num_tiles).reshape(pieces, size)
    first = rows[:, :1]
    with jax.enable_x64(not fits):
        dtype = jnp.uint32 if fits else jnp.uint64
        shift = jnp.array(bits, dtype)
        keys = (tiles.astype(dtype) << shift) | jnp.clip(rows - first, 0, most).astype(dtype)
        keys = jnp.stack([lax.sort(piece) for piece in keys])
        starts = jnp.arange(num_tiles + 1, dtype=dtype) << shift
        bounds = jax.vmap(lambda piece: jnp.searchsorted(piece, starts))(keys).astype(jnp.int32)
        tiles = (keys >> shift).astype(jnp.int32)
        rows = (keys & ((jnp.array(1, dtype) << shift) - jnp.array(1, dtype))).astype(jnp.int32)
    rows = jnp.minimum(rows + first, num_rows - 1)
    return (rows[0], bounds[0]) if pieces == 1 else _join(tiles, rows, bounds, room)


def _join(tiles: Int[Array, "s n"], rows: Int[Array, "s n"], bounds: Int[Array, "s tiles_and_one"], room: int):
    """The rows of sorted pieces, piece after piece within each tile, and where each tile's begin."""
    num_pieces, size = tiles.shape
    counts = jnp.diff(bounds, axis=1, append=size)
    begins = jnp.sum(bounds, axis=0)  # as many stand before a tile as stand before it in all pieces
    moves = begins + jnp.cumsum(counts, axis=0) - counts - bounds  # of a piece's part in a tile
    numbers = jnp.arange(num_pieces, dtype=jnp.int32)[:, None] * bounds.shape[1] + tiles
    places = (moves.reshape(-1)[numbers] + jnp.arange(size, dtype=jnp.int32)).reshape(-1)
    return jnp.zeros_like(places).at[places].set(rows.reshape(-1), unique_indices=True)[:room], begins
