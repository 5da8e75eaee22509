"""What binning and compositing read of each row (camera, Gaussian): one table, sorted front to back as a whole.

Columns: x, y, p, q, r and the opacity's logarithm; the channels; half the width and height of the box.

Sorted, a row's number is its place in depth, and what tiles read of it in one turn lies near together in memory.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from ssplat_jax.numerics import apart, safe_log
from ssplat_jax.render import constants
from ssplat_jax.render.projection import Splats

SHAPE, BOX = 6, 2  # columns before the channels and behind them


def splat_table(splats: Splats, channels: Float[Array, "b n c"]) -> Float[Array, "m f"]:
    """The rows of all cameras, `m = b n`, camera-major. Boxes have no size where nothing is seen.

    The opacity enters as its logarithm: an alpha is then one exponential, whose limits act on its power. XLA keeps the
    exponentials of a turn, and does again in every kernel what comes after them.
    """
    logs = safe_log(splats.opacities, 0.5 * constants.ALPHA_MIN)
    # Of those that are seen none has less; that of 1/255 may be rounded to less.
    logs += lax.stop_gradient(jnp.maximum(logs, constants.LOG_ALPHA_MIN) - logs)
    boxes = lax.stop_gradient(splats.extents)
    parts = (splats.means2d, splats.factors, logs[..., None], channels, boxes)
    table = apart(jnp.any(splats.visible), lambda: jnp.concatenate(parts, axis=-1))
    return table.reshape(-1, table.shape[-1])


def depth_order(splats: Splats) -> Int[Array, " m"]:
    """Rows from near to far, ties by row number; invisible rows last.

    One 64-bit integer a row, depth bits above row number, whatever `jax_enable_x64` says: exact and without payload.
    Depths in float64 fill that integer alone and are sorted with their row.
    """
    depths, visible = splats.depths.reshape(-1), splats.visible.reshape(-1)
    if depths.dtype == jnp.float64:
        rows = lax.iota(jnp.int32, depths.shape[0])
        return lax.sort((jnp.where(visible, depths, jnp.inf), rows), num_keys=2)[1]
    with jax.enable_x64(True):
        bits = lax.bitcast_convert_type(jnp.where(visible, depths, jnp.inf), jnp.uint32)  # in the order of the depths
        keys = (bits.astype(jnp.uint64) << jnp.uint64(32)) | lax.iota(jnp.uint64, depths.shape[0])
        return (lax.sort(keys) & jnp.uint64(0xFFFFFFFF)).astype(jnp.int32)


def sort_rows(table: Float[Array, "m f"], order: Int[Array, " m"]) -> Float[Array, "m f"]:
    """`table[order]`, copied row by row; the gradient goes back to where the rows came from."""
    always = order[0] >= 0  # which the compiler does not know
    return apart(always, lambda: table.at[order].get(mode="promise_in_bounds", unique_indices=True))
