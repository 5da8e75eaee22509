"""Which Gaussians touch which tile, front to back: sorted (tile, Gaussian) pairs.

Rows are (camera, Gaussian) flattened to `m = b n`; tiles are numbered camera-major, row-major. Gaussians are sorted
once by (depth, row); a pair's key is then `tile << bits | depth rank`, so that a sort of plain integers puts
everything in exact order. XLA sorts single integers five times faster than (key, payload) tuples, hence the packing.
Pairs are found from near to far, so that pieces of them, sorted each by itself, need only be laid one after the other
within each tile: XLA's CPU runtime sorts the pieces on all cores, a single array on one.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Int, Shaped

from ssplat_jax.render import constants
from ssplat_jax.render.projection import Splats
from ssplat_jax.struct import pytree, static

EIGHTHS = (5, 6, 8)  # of the room for pairs (a power of two): the least share that holds them is what is sorted
WORTH_CHOOSING = 1 << 16  # room for pairs below which all of it is sorted: each share is compiled by itself
PIECES = 16  # sorted by themselves where room is chosen; the CPU runtime shares out what waits from nine at a time on
PARTS = 4  # turns of the loop in `_tiles`; a loop of one is none
MOST_PAIRS = (1 << 31) - 1  # what an index reaches; counts of pairs stop there
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

    rows: Int[Array, " p"]
    bounds: Int[Array, " tiles_and_one"]  # pairs whose ellipse misses the tile are left out
    num_pairs: Int[Array, ""]  # needed; those beyond the capacity `p` (the farthest Gaussians) are missing


def tile_boxes(splats: Splats, grid: Grid) -> Int[Array, "m 4"]:
    """Tile ranges (x from, y from, columns, rows) that each row's box covers; invisible ones cover none."""
    limit = jnp.array([grid.columns, grid.rows], splats.means2d.dtype)
    low = jnp.clip(jnp.floor((splats.means2d - splats.extents) / grid.tile), 0, limit)
    high = jnp.clip(jnp.floor((splats.means2d + splats.extents) / grid.tile) + 1, 0, limit)
    size = jnp.where(splats.visible[..., None], high - low, 0)
    return jnp.concatenate([low, size], axis=-1).astype(jnp.int32).reshape(-1, 4)


def count_pairs(splats: Splats, grid: Grid) -> Int[Array, ""]:
    """Pairs that `bin_splats` needs room for; `MOST_PAIRS` stands for any number from there on."""
    boxes = tile_boxes(splats, grid)
    return _running_sum(boxes[:, 2] * boxes[:, 3])[-1]


def _running_sum(counts: Int[Array, " m"]) -> Int[Array, " m"]:
    """Inclusive sums that stop at `MOST_PAIRS`: 20,000 Gaussians before all tiles of a 4k image already pass it."""
    with jax.enable_x64(True):
        return jnp.minimum(jnp.cumsum(counts.astype(jnp.int64)), MOST_PAIRS).astype(jnp.int32)


def depth_order(splats: Splats) -> Int[Array, " m"]:
    """Rows from near to far, ties by row number; invisible rows last (and all alike: row 0).

    One 64-bit integer a row, depth bits above row number, whatever `jax_enable_x64` says: exact and without payload.
    Depths in float64 fill that integer alone and are sorted with their row.
    """
    depths, visible = splats.depths.reshape(-1), splats.visible.reshape(-1)
    if depths.dtype == jnp.float64:
        rows = lax.iota(jnp.int32, depths.shape[0])
        return jnp.where(visible, rows, 0)[lax.sort((jnp.where(visible, depths, jnp.inf), rows), num_keys=2)[1]]
    with jax.enable_x64(True):
        bits = lax.bitcast_convert_type(depths, jnp.uint32).astype(jnp.uint64)  # positive floats sort as integers
        keys = (bits << jnp.uint64(32)) | lax.iota(jnp.uint64, depths.shape[0])
        keys = lax.sort(jnp.where(visible, keys, jnp.uint64(0xFFFFFFFF00000000)))
        return (keys & jnp.uint64(0xFFFFFFFF)).astype(jnp.int32)


def bin_splats(splats: Splats, grid: Grid, max_pairs: int) -> Pairs:
    """The sorted pairs of `splats` and tiles, at most `max_pairs` of them."""
    order = depth_order(splats)
    num_rows = order.shape[0]
    visible_first = jnp.arange(num_rows) < jnp.sum(splats.visible)
    seen = jnp.any(splats.visible)
    boxes = jnp.where(visible_first[:, None], take_rows(tile_boxes(splats, grid), order, seen), 0)
    ends = _running_sum(boxes[:, 2] * boxes[:, 3])
    outlines = _outlines(splats, boxes, ends, order, seen, grid)

    def sorted_pairs(room: int):
        ranks = _owners(ends, room)
        ranks, bounds = _sort_pairs(_tiles(outlines, ranks, ends[-1], grid), ranks, grid.num_tiles, num_rows)
        return jnp.pad(order[ranks], (0, max_pairs - room)), bounds

    shares = EIGHTHS if max_pairs >= WORTH_CHOOSING else EIGHTHS[-1:]
    rooms = sorted({-(-max_pairs * share // 8) for share in shares})
    enough = jnp.sum(ends[-1] > jnp.array(rooms[:-1], jnp.int32), dtype=jnp.int32)
    rows, bounds = lax.switch(enough, [functools.partial(sorted_pairs, room) for room in rooms])
    return Pairs(rows=rows, bounds=bounds, num_pairs=ends[-1])


def take_rows(table: Shaped[Array, "m f"], rows: Int[Array, " p"], wanted: Bool[Array, ""]) -> Shaped[Array, "p f"]:
    """`table[rows]` if `wanted`, else zeros: copied row by row, since it is done apart."""
    return apart(wanted, lambda: table[rows])


def apart(wanted: Bool[Array, ""], compute: Callable[[], Array]) -> Array:
    """`compute()` if `wanted`, else zeros: by kernels of its own, from operands that are there.

    Left to itself, XLA's CPU compiler fuses a gather with what stands around it, does it again in each kernel that
    uses it, and goes entry by entry (`lax.optimization_barrier` is gone by then). It fuses nothing across the edge of
    a branch. A loop would do as well, but first fills its result with zeros.
    """
    shape = jax.eval_shape(compute)
    return lax.cond(wanted, compute, lambda: jnp.zeros(shape.shape, shape.dtype))


def _outlines(
    splats: Splats,
    boxes: Int[Array, "m 4"],
    ends: Int[Array, " m"],
    order: Int[Array, " m"],
    seen: Bool[Array, ""],
    grid: Grid,
):
    """What the pairs of each Gaussian are found from, in depth order: integers and floats `[m]`.

    Its first pair, its first tile and the columns of its box; its mean from the centre of that tile's first pixel, the
    factors of its exponent, and the largest exponent at which alpha is still 1/255.
    """
    image = order // splats.depths.shape[1]
    first_tiles = (image * grid.rows + boxes[:, 1]) * grid.columns + boxes[:, 0]
    whole = ends - boxes[:, 2] * boxes[:, 3], first_tiles, jnp.maximum(boxes[:, 2], 1)
    bounds = jnp.log(jnp.maximum(splats.opacities / constants.ALPHA_MIN, 1.0))
    columns = [*jnp.moveaxis(splats.means2d, -1, 0), *jnp.moveaxis(splats.factors, -1, 0), bounds]
    x, y, *rest = take_rows(jnp.stack([column.reshape(-1) for column in columns], axis=-1), order, seen).T
    x, y = (mean - ((boxes[:, i] * grid.tile).astype(mean.dtype) + 0.5) for i, mean in enumerate((x, y)))
    return whole, (x, y, *rest)


def _tiles(outlines, ranks: Int[Array, " p"], num_pairs: Int[Array, ""], grid: Grid) -> Int[Array, " p"]:
    """The tile of every pair; `grid.num_tiles` where there is none, or one that the Gaussian's ellipse misses.

    In a loop, whose operands are there before it: one kernel then reads what it needs of each pair's Gaussian.
    """
    padded = jnp.pad(ranks, (0, -ranks.shape[0] % PARTS)).reshape(PARTS, -1)

    def part(operands):
        number, ranks = operands
        (starts, tiles, columns), (x, y, *rest) = jax.tree.map(lambda column: column[ranks], outlines)
        pair = number * ranks.shape[0] + jnp.arange(ranks.shape[0], dtype=jnp.int32)
        down = (pair - starts) // columns
        right = pair - starts - down * columns
        low = [(side * grid.tile).astype(x.dtype) - mean for side, mean in ((right, x), (down, y))]
        reached = _reaches(low, rest, grid.tile) & (pair < num_pairs)
        return jnp.where(reached, tiles + down * grid.columns + right, grid.num_tiles)

    return lax.map(part, (jnp.arange(PARTS, dtype=jnp.int32), padded)).reshape(-1)[: ranks.shape[0]]


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
    tiles: Int[Array, " p"], ranks: Int[Array, " p"], num_tiles: int, num_rows: int
) -> tuple[Int[Array, " p"], Int[Array, " tiles_and_one"]]:
    """Depth ranks in order of (tile, rank), and where each tile's begin, of pairs in order of rank."""
    room = tiles.shape[0]
    pieces = PIECES if room >= WORTH_CHOOSING else 1
    padding = (0, -room % pieces)
    bits = max(1, (num_rows - 1).bit_length())
    fits = num_tiles.bit_length() + bits <= KEY_BITS
    with jax.enable_x64(not fits):
        dtype = jnp.uint32 if fits else jnp.uint64
        shift = jnp.array(bits, dtype)
        tiles = jnp.pad(tiles, padding, constant_values=num_tiles).astype(dtype)
        keys = (tiles << shift) | jnp.pad(ranks, padding).astype(dtype)
        keys = jnp.stack([lax.sort(piece) for piece in jnp.split(keys, pieces)])
        starts = jnp.arange(num_tiles + 1, dtype=dtype) << shift
        bounds = jax.vmap(lambda piece: jnp.searchsorted(piece, starts))(keys).astype(jnp.int32)
        tiles = (keys >> shift).astype(jnp.int32)
        ranks = (keys & ((jnp.array(1, dtype) << shift) - jnp.array(1, dtype))).astype(jnp.int32)
    ranks = jnp.minimum(ranks, num_rows - 1)
    return (ranks[0], bounds[0]) if pieces == 1 else _join(tiles, ranks, bounds, room)


def _join(tiles: Int[Array, "s n"], ranks: Int[Array, "s n"], bounds: Int[Array, "s tiles_and_one"], room: int):
    """The ranks of sorted pieces, piece after piece within each tile, and where each tile's begin."""
    num_pieces, size = tiles.shape
    counts = jnp.diff(bounds, axis=1, append=size)
    begins = jnp.sum(bounds, axis=0)  # as many stand before a tile as stand before it in all pieces
    moves = begins + jnp.cumsum(counts, axis=0) - counts - bounds  # of a piece's part in a tile
    numbers = jnp.arange(num_pieces, dtype=jnp.int32)[:, None] * bounds.shape[1] + tiles
    places = (moves.reshape(-1)[numbers] + jnp.arange(size, dtype=jnp.int32)).reshape(-1)
    return jnp.zeros_like(places).at[places].set(ranks.reshape(-1), unique_indices=True)[:room], begins
