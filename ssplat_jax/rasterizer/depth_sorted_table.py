"""What binning and compositing read of each row (camera, Gaussian): one table, sorted front to back as a whole.

Columns: x, y, p, q, r and the opacity's logarithm; the channels; left, top, width and height of the box, in tiles.

Sorted, a row's number is its place in depth, and what tiles read of it in one turn lies near together in memory.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ssplat_jax.numerics import safe_log
from ssplat_jax.rasterizer import constants
from ssplat_jax.rasterizer.projection import Splats
from ssplat_jax.rasterizer.tile_grid import Grid, tile_boxes
from ssplat_jax.xla_cpu import apart

SHAPE, BOX = 6, 4  # columns before the channels and behind them


def sorted_table(
    splats: Splats, channels: Float[Array, "b n c"], grid: Grid
) -> tuple[Float[Array, "m f"], Int[Array, " m"]]:
    """The table of all cameras' rows, `m = b n`, from near to far, and where each was before, camera-major.

    Rows that touch no tile come last, so that those of consecutive pairs follow each other. The gradient goes back to
    where the rows came from.
    """
    boxes = tile_boxes(splats.means2d, splats.extents, grid)
    order = depth_order(splats.depths, splats.visible & (boxes[2] * boxes[3] > 0))
    table = splat_table(splats, channels, jnp.stack(boxes, axis=-1))
    always = order[0] >= 0  # which the compiler does not know
    return apart(always, lambda: table.at[order].get(mode="promise_in_bounds", unique_indices=True)), order


def splat_table(splats: Splats, channels: Float[Array, "b n c"], boxes: Int[Array, "b n 4"]) -> Float[Array, "m f"]:
    """The rows as they come.

    The opacity enters as its logarithm: an alpha is then one exponential, whose limits act on its power. XLA keeps the
    exponentials of a turn, and does again in every kernel what comes after them.
    """
    logs = safe_log(splats.opacities, 0.5 * constants.ALPHA_MIN)
    # Of those that are seen none has less; that of 1/255 may be rounded to less.
    logs += lax.stop_gradient(jnp.maximum(logs, constants.LOG_ALPHA_MIN) - logs)
    parts = (splats.means2d, splats.factors, logs[..., None], channels, boxes.astype(logs.dtype))
    table = apart(jnp.any(splats.visible), lambda: jnp.concatenate(parts, axis=-1))
    return table.reshape(-1, table.shape[-1])


def depth_order(depths: Float[Array, "b n"], shown: Bool[Array, "b n"]) -> Int[Array, " m"]:
    """Rows from near to far, ties by row number; those not shown last.

    One 64-bit integer a row, depth bits above row number, whatever `jax_enable_x64` says: exact and without payload.
    Depths in float64 fill that integer alone and are sorted with their row.
    """
    depths, shown = depths.reshape(-1), shown.reshape(-1)
    if depths.dtype == jnp.float64:
        keys = jnp.where(shown, depths, jnp.nan)  # behind an infinite depth
        return lax.sort((keys, lax.iota(jnp.int32, keys.shape[0])), num_keys=2)[1]
    bits = lax.bitcast_convert_type(depths, jnp.uint32)  # in the order of the depths, the infinite one below the last
    bits = jnp.where(shown, bits, jnp.uint32(0xFFFFFFFF))
    with jax.enable_x64(True):
        keys = (bits.astype(jnp.uint64) << jnp.uint64(32)) | lax.iota(jnp.uint64, bits.shape[0])
        return (lax.sort(keys) & jnp.uint64(0xFFFFFFFF)).astype(jnp.int32)
