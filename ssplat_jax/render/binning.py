"""Which Gaussians touch which tile, front to back: sorted (tile, Gaussian) pairs.

Rows are those of a `splat_table` sorted from near to far; tiles are numbered camera-major, row-major. A pair's key is
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

from ssplat_jax.numerics import apart, columns
from ssplat_jax.render import constants
from ssplat_jax.render.projection import Splats
from ssplat_jax.render.table import BOX, SHAPE
from ssplat_jax.struct import pytree, static

# In sixteenths, of the room for pairs (a power of two): the least share that holds them is what is sorted.
SHARES = (9, 11, 13, 16)
WORTH_CHOOSING = 1 << 16  # room for pairs below which all of it is sorted: each share is compiled by itself
PIECES = 16  # sorted by themselves where room is chosen; the CPU runtime shares out what waits from nine at a time on
MOST_PAIRS = (1 << 31) - 1  # what an index reaches; counts of pairs stop there
READ_AHEAD = 8  # places behind the last pair that may be read
KEY_BITS = 32  # keys wider than this are sorted as 64-bit integers


@pytree
class Grid:
    """The tiles of `b` images of one size."""

    num_images: int = static()
    height: int = static()
    width: int = static()
    tile: int = static()

    @property
    def rows(self) -> int:
        """Tiles down an image."""
        return -(-self.height // self.tile)

    @property
    def columns(self) -> int:
        """Tiles across an image."""
        return -(-self.width // self.tile)

    @property
    def num_tiles(self) -> int:
        """Tiles of all images."""
        return self.num_images * self.rows * self.columns


@pytree
class Pairs:
    """For each tile the rows that touch it, front to back: `rows[bounds[t] : bounds[t + 1]]`."""

    rows: Int[Array, " p"]  # room for pairs, and `READ_AHEAD` more
    bounds: Int[Array, " tiles_and_one"]  # pairs whose ellipse misses the tile are left out
    num_pairs: Int[Array, ""]  # needed; those beyond the room (the farthest Gaussians) are missing


def tile_boxes(means2d: Float[Array, "*m 2"], halves: Float[Array, "*m 2"], grid: Grid) -> tuple[Int[Array, "*m"], ...]:
    """Tile ranges (x from, y from, columns, rows) that each row's box covers; boxes of no size cover none."""
    sides = []
    for mean, half, limit in zip(columns(means2d), columns(halves), (grid.columns, grid.rows), strict=True):
        low, high = (jnp.floor((mean + sign * half) / grid.tile) for sign in (-1, 1))
        low, high = jnp.clip(low, 0, limit), jnp.clip(high + 1, 0, limit)
        sides.append((low.astype(jnp.int32), jnp.where(half > 0, high - low, 0).astype(jnp.int32)))
    (left, width), (top, height) = sides
    return left, top, width, height


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
        table: as `splat_table` makes it, sorted.
        images: which image each row is seen in.
        grid: the tiles.
        max_pairs: room for pairs.
    """
    num_rows = table.shape[0]
    left, top, width, height = tile_boxes(table[:, :2], table[:, -BOX:], grid)
    ends = _running_sum(width * height)
    # What a row's pairs are found from: its first pair, its first tile and the columns of its box; its mean from the
    # centre of that tile's first pixel, the factors of its exponent, and the largest exponent with alpha still 1/255.
    first_tiles = (images * grid.rows + top) * grid.columns + left
    x, y, *factors, logs = columns(table[:, :SHAPE])
    x, y = (mean - ((side * grid.tile).astype(mean.dtype) + 0.5) for mean, side in ((x, left), (y, top)))
    outlines = (
        (ends - width * height, first_tiles, jnp.maximum(width, 1)),
        (x, y, *factors, logs - constants.LOG_ALPHA_MIN),
    )

    def sorted_pairs(room: int):
        rows = _owners(ends, room)
        rows, bounds = _sort_pairs(_tiles(outlines, rows, ends[-1], grid), rows, grid.num_tiles, num_rows)
        return jnp.pad(rows, (0, max_pairs - room + READ_AHEAD)), bounds

    shares = SHARES if max_pairs >= WORTH_CHOOSING else SHARES[-1:]
    rooms = sorted({-(-max_pairs * share // 16) for share in shares})
    enough = jnp.sum(ends[-1] > jnp.array(rooms[:-1], jnp.int32), dtype=jnp.int32)
    rows, bounds = lax.switch(enough, [functools.partial(sorted_pairs, room) for room in rooms])
    return Pairs(rows=rows, bounds=bounds, num_pairs=ends[-1])


def _tiles(outlines, rows: Int[Array, " p"], num_pairs: Int[Array, ""], grid: Grid) -> Int[Array, " p"]:
    """The tile of every pair; `grid.num_tiles` where there is none, or one that the Gaussian's ellipse misses."""

    def tiles_of():
        (starts, tiles, columns), (x, y, *rest) = jax.tree.map(lambda column: column[rows], outlines)
        pair = jnp.arange(rows.shape[0], dtype=jnp.int32)
        down = (pair - starts) // columns
        right = pair - starts - down * columns
        low = [(side * grid.tile).astype(x.dtype) - mean for side, mean in ((right, x), (down, y))]
        reached = _reaches(low, rest, grid.tile) & (pair < num_pairs)
        return jnp.where(reached, tiles + down * grid.columns + right, grid.num_tiles)

    return apart(num_pairs >= 0, tiles_of)  # always, which the compiler does not know


def _reaches(low, shape, tile: int):
    """Whether a Gaussian's ellipse of alpha = 1/255 reaches the pixel centres of a tile: a quarter of a box's do not.

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
    """Rows in order of (tile, row), and where each tile's begin, of pairs in order of row."""
    room = tiles.shape[0]
    pieces = PIECES if room >= WORTH_CHOOSING else 1
    padding = (0, -room % pieces)
    bits = max(1, (num_rows - 1).bit_length())
    fits = num_tiles.bit_length() + bits <= KEY_BITS
    with jax.enable_x64(not fits):
        dtype = jnp.uint32 if fits else jnp.uint64
        shift = jnp.array(bits, dtype)
        tiles = jnp.pad(tiles, padding, constant_values=num_tiles).astype(dtype)
        keys = (tiles << shift) | jnp.pad(rows, padding).astype(dtype)
        keys = jnp.stack([lax.sort(piece) for piece in jnp.split(keys, pieces)])
        starts = jnp.arange(num_tiles + 1, dtype=dtype) << shift
        bounds = jax.vmap(lambda piece: jnp.searchsorted(piece, starts))(keys).astype(jnp.int32)
        tiles = (keys >> shift).astype(jnp.int32)
        rows = (keys & ((jnp.array(1, dtype) << shift) - jnp.array(1, dtype))).astype(jnp.int32)
    rows = jnp.minimum(rows, num_rows - 1)
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
