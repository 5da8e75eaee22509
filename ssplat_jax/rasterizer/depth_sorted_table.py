"""The depth-sorted table: one row for each (camera, Gaussian), all that binning and compositing read of it.

It is one array, sorted front to back as a whole: a row's number is its place in depth, and rows that tiles read
together are neighbors in memory.

Columns, in this order:
    MEAN_X, MEAN_Y: `means2d`, pixels.
    FACTORS: the three `conic_factors`, 1/px.
    LOG_OPACITY: natural logarithm of the opacity.
    CHANNELS: what is composited, any number of columns.
    BOX: left, top, width and height of the box around the ellipse, in tiles.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ssplat_jax.core.numerics import safe_log
from ssplat_jax.core.xla_cpu import in_own_kernel
from ssplat_jax.rasterizer import constants
from ssplat_jax.rasterizer.projection import Splats
from ssplat_jax.rasterizer.tile_grid import Grid, tile_boxes

MEAN_X, MEAN_Y, LOG_OPACITY = 0, 1, 5
FACTORS = slice(2, 5)

SHAPE_COLUMNS = range(6)
"""The columns above, from which alphas are computed."""

BOX_COLUMNS = range(-4, 0)
"""Left, top, width and height of the box."""

SHAPE = slice(0, 6)
CHANNELS = slice(6, -4)
BOX = slice(-4, None)
BOX_SIZE = slice(-2, None)
WITHOUT_BOX = slice(0, -4)
"""The columns that compositing reads and that have gradients: shape and channels."""


def num_channels(table: Float[Array, "m f"]) -> int:
    """Number of channel columns of a table."""
    return table.shape[1] - len(SHAPE_COLUMNS) - len(BOX_COLUMNS)


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

    Each row is one 64-bit integer, depth bits above row number, whatever `jax_enable_x64` says: exact, and without a
    payload (an argsort of 65,536 floats takes 18.5 ms on a CPU, this 3.1 ms: docs/performance.md). Depths in float64
    fill that integer alone and are sorted together with their row.
    """
    depths, shown = depths.reshape(-1), shown.reshape(-1)
    if depths.dtype == jnp.float64:
        keys = jnp.where(shown, depths, jnp.nan)  # NaN sorts behind infinite depths
        return lax.sort((keys, lax.iota(jnp.int32, keys.shape[0])), num_keys=2)[1]
    bits = lax.bitcast_convert_type(depths, jnp.uint32)  # same order as the depths; infinity is below the last key
    bits = jnp.where(shown, bits, jnp.uint32(0xFFFFFFFF))
    with jax.enable_x64(True):
        keys = (bits.astype(jnp.uint64) << jnp.uint64(32)) | lax.iota(jnp.uint64, bits.shape[0])
        return (lax.sort(keys) & jnp.uint64(0xFFFFFFFF)).astype(jnp.int32)
