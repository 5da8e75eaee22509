"""From splats to sorted tile intersections: the depth-sorted table, and the (tile, Gaussian) pairs of each tile.

The table has one row for each (camera, Gaussian): all that binning and compositing read. It is one array, sorted front
to back as a whole: a row's number is its place in depth, and rows that tiles read together are neighbors in memory.
Columns, in this order:
    MEAN_X, MEAN_Y: `means2d`, pixels.
    FACTORS: the three `conic_factors`, 1/px.
    LOG_OPACITY: natural logarithm of the opacity.
    CHANNELS: what is composited, any number of columns.
    BOX: left, top, width and height of the box around the ellipse, in tiles.

Tiles are numbered camera-major, then row-major. A pair's key is `tile << bits | row`, so that a sort of plain integers
gives the exact order. XLA's CPU backend sorts single integers five times faster than (key, payload) tuples, hence the
packing. Pairs are found from near to far, so pieces of them that are sorted separately only need to be joined tile by
tile (`cpu_backend.sort_pieces`).
"""

import functools

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ssplat_jax.core.cpu_backend import SORT_PIECES, by_platform, in_own_kernel, packed_argsort, sort_pieces
from ssplat_jax.core.numerics import columns, safe_log
from ssplat_jax.core.pytree import pytree, static
from ssplat_jax.rasterizer import constants
from ssplat_jax.rasterizer.projection import Splats


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


def tile_boxes(means2d: Float[Array, "*m 2"], radii: Float[Array, "*m 2"], grid: Grid) -> tuple[Int[Array, "*m"], ...]:
    """Left, top, width and height, in tiles, of what each box covers; boxes of radius 0 cover none."""
    sides = []
    for mean, radius, limit in zip(columns(means2d), columns(radii), (grid.columns, grid.rows), strict=True):
        low, high = (jnp.floor((mean + sign * radius) / grid.tile) for sign in (-1, 1))
        low, high = jnp.clip(low, 0, limit), jnp.clip(high + 1, 0, limit)
        sides.append((low.astype(jnp.int32), jnp.where(radius > 0, high - low, 0).astype(jnp.int32)))
    (left, width), (top, height) = sides
    return left, top, width, height


MEAN_X, MEAN_Y, LOG_OPACITY = 0, 1, 5
FACTORS = slice(2, 5)

SHAPE_COLUMNS = range(6)  # the columns above, from which alphas are computed
BOX_COLUMNS = range(-4, 0)  # left, top, width and height of the box

SHAPE = slice(0, 6)
CHANNELS = slice(6, -4)
BOX = slice(-4, None)
BOX_SIZE = slice(-2, None)
WITHOUT_BOX = slice(0, -4)  # the columns that compositing reads and that have gradients: shape and channels


def sorted_table(
    splats: Splats, channels: Float[Array, "b n c"], grid: Grid
) -> tuple[Float[Array, "m f"], Int[Array, " m"]]:
    """The table of all cameras' rows, `m = b n`, from near to far, and each row's number before, camera-major.

    Rows that touch no tile come last, so that those of consecutive tile intersections follow each other. Gradients
    return to where the rows came from.
    """
    boxes = tile_boxes(splats.means2d, splats.radii, grid)
    order = _depth_order(splats.depths, splats.visible & (boxes[2] * boxes[3] > 0))
    table = _unsorted_table(splats, channels, jnp.stack(boxes, axis=-1))
    always = order[0] >= 0  # the compiler does not know that it is always true
    return in_own_kernel(always, lambda: table.at[order].get(mode="promise_in_bounds", unique_indices=True)), order


def _unsorted_table(splats: Splats, channels: Float[Array, "b n c"], boxes: Int[Array, "b n 4"]) -> Float[Array, "m f"]:
    """The table, camera-major.

    The opacity enters as its logarithm: an alpha is then a single exponential, and its limits act on the exponent. XLA
    keeps the result of an exponential, but repeats in every kernel what comes after it.
    """
    logs = safe_log(splats.opacities, 0.5 * constants.ALPHA_MIN)
    # No visible Gaussian is fainter than 1/255, but the logarithm of 1/255 may be rounded down.
    logs += lax.stop_gradient(jnp.maximum(logs, constants.LOG_ALPHA_MIN) - logs)
    parts = (splats.means2d, splats.conic_factors, logs[..., None], channels, boxes.astype(logs.dtype))
    table = in_own_kernel(jnp.any(splats.visible), lambda: jnp.concatenate(parts, axis=-1))
    return table.reshape(-1, table.shape[-1])


def _depth_order(depths: Float[Array, "b n"], shown: Bool[Array, "b n"]) -> Int[Array, " m"]:
    """Rows from near to far, ties by row number; those not shown last.

    Depths in float64 fill an integer alone and are sorted together with their row.
    """
    depths, shown = depths.reshape(-1), shown.reshape(-1)
    if depths.dtype == jnp.float64:
        keys = jnp.where(shown, depths, jnp.nan)  # NaN sorts behind infinite depths
        return lax.sort((keys, lax.iota(jnp.int32, keys.shape[0])), num_keys=2)[1]
    bits = lax.bitcast_convert_type(depths, jnp.uint32)  # same order as the depths; infinity is below the last key
    return packed_argsort(jnp.where(shown, bits, jnp.uint32(0xFFFFFFFF)))


CAPACITY_SHARES = (17, 20, 24, 28, 32)
"""In 32nds of the capacity, a power of two: the smallest share that holds all pairs is sorted."""

MIN_SHARED_CAPACITY, MIN_PIECES_CAPACITY = 1 << 21, 1 << 16
"""Below these capacities all of it is sorted, and in one piece: every share and piece takes long to compile. With all
shares a render compiles in 15 s of a core instead of 8; it takes 2 to 5 % less time at 262,144 and 524,288 pairs, and
7 % less at 1,048,576."""

MAX_PAIRS = (1 << 31) - 1  # largest index; counts of pairs stop there
READ_AHEAD = 16  # entries behind the last pair that may be read
KEY_BITS = 32  # keys wider than this are sorted as 64-bit integers


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
        # The row of each pair: pairs of a row follow each other, and end (exclusively) at `ends`.
        steps = jnp.zeros((capacity,), jnp.int32).at[ends].add(1, mode="drop")
        rows = jnp.minimum(jnp.cumsum(steps), num_rows - 1)
        tiles = _tiles(table, images, ends, rows, grid)
        in_pieces = lambda pieces: lambda: _sort_pairs(tiles, rows, grid.num_tiles, num_rows, pieces)  # noqa: E731
        pieces = SORT_PIECES if max_pairs >= MIN_PIECES_CAPACITY else 1
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


def _sort_pairs(
    tiles: Int[Array, " p"], rows: Int[Array, " p"], num_tiles: int, num_rows: int, pieces: int
) -> tuple[Int[Array, " p"], Int[Array, " tiles_and_one"]]:
    """Rows in order of (tile, row), and bounds as in `TileIntersections`; pairs of tile `num_tiles` are left out.

    The given rows ascend with none left out. `pieces` arrays are sorted side by side, in which rows are counted from
    the first: that takes fewer bits, so that most keys fit in 32.
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
