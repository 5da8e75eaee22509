"""The fast path: tiles composited front to back in batches of similar load, with a gradient that recomputes.

A step of the loop takes the next Gaussians of each of many tiles; a `Schedule` says how many. Arrays are `[p u t]`:
pixels of a tile, the step's Gaussians, the batch's tiles. Every kernel then runs over contiguous tiles with the pixel's
offset as a constant, and sums over Gaussians or pixels are sums over a short middle axis (XLA's CPU backend vectorizes
those; sums over the last or a long first axis cost five times as much). Nothing per sample is stored: the backward pass
repeats the same steps, front to back, with the totals of the forward pass.

    w_i = a_i T_i,  T_{i+1} = T_i (1 - a_i)        out = sum_i w_i c_i
    dL/da_i = T_i s_i - tail_i / (1 - a_i)   with s_i = c_i . dL/dout and tail_i = sum_{j>i} w_j s_j
"""

import dataclasses
import functools
import math
import operator
from collections.abc import Callable, Iterable
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from ssplat_jax.core.cpu_backend import by_platform, in_own_kernel, short_exp
from ssplat_jax.core.numerics import with_rank_promotion
from ssplat_jax.rasterizer import binning, constants
from ssplat_jax.rasterizer.binning import Grid, TileIntersections

Results = TypeVar("Results")


@dataclasses.dataclass(frozen=True)
class Schedule:
    """The work of one step of the loop; results do not depend on it, except for rounding."""

    step_size: int
    """Gaussians of a tile in one step, at most `binning.READ_AHEAD`: a tile's last step may read behind all pairs."""
    batch_size: int
    """Tiles composited side by side."""


ON_CPU = Schedule(step_size=8, batch_size=128)  # neither twice as many Gaussians nor twice as many tiles are faster

ON_ACCELERATOR = Schedule(step_size=16, batch_size=1 << 15)
"""Few, wide steps: a GPU launches kernels and asks the host at every one. The limit on tiles bounds the memory."""

LOG_ALPHA_MAX = math.log(constants.ALPHA_MAX)

CAPPED_ALPHA = constants.ALPHA_MAX * (1 - 1e-5)
"""Alphas from here on are capped: `short_exp(LOG_ALPHA_MAX)` is not less."""

STEP_CHANNELS = slice(binning.CHANNELS.start, None)
"""The channels of a step's columns, which have no box; the ones from which alpha is composited come last."""


@functools.partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def composite(
    grid: Grid, with_alpha: bool, table: Float[Array, "m f"], intersections: TileIntersections
) -> Float[Array, "tiles co p"]:
    """The channels of a `sorted_table` composited over every tile's pixels.

    Args:
        grid: the tiles.
        with_alpha: whether alpha follows as the last channel.
        table: from `sorted_table`.
        intersections: from `intersect_tiles`.

    Returns:
        Sums of weight times channel for each tile, channel and pixel. Gradients reach the table's shape and channels.
        Samples fainter than 1/255 or capped at 0.99 have no gradient by their opacity.
    """
    return _composite_fwd(grid, with_alpha, table, intersections)[0]


def _by_platform(compute: Callable[[Schedule], Results]) -> Results:
    """`compute` with the schedule for the platform that the program is compiled for."""
    return by_platform(cpu=lambda: compute(ON_CPU), other=lambda: compute(ON_ACCELERATOR))


def _forward(grid: Grid, with_alpha: bool, table, intersections: TileIntersections, schedule: Schedule):
    channels = table[:, binning.CHANNELS].shape[1] + with_alpha  # a channel of ones becomes alpha

    def batch(out, tiles):
        def step(_, values, alphas, transmittance, out):
            weights, afters = _weights(alphas, transmittance)
            return afters[-1], out + _total(weight * values[STEP_CHANNELS, None, u] for u, weight in enumerate(weights))

        start = jnp.zeros((channels, grid.tile**2, tiles.shape[0]), table.dtype)
        drawn = _run_steps(grid, table, intersections, tiles, schedule, step, start, with_ones=with_alpha)
        return out.at[tiles].set(jnp.moveaxis(drawn, -1, 0), mode="drop"), None

    out = jnp.zeros((grid.num_tiles, channels, grid.tile**2), table.dtype)
    return lax.scan(batch, out, _batches(intersections.bounds, grid, schedule))[0]


def _composite_fwd(grid: Grid, with_alpha: bool, table, intersections: TileIntersections):
    out = _by_platform(functools.partial(_forward, grid, with_alpha, table, intersections))
    return out, (table, intersections, out)


@with_rank_promotion
def _composite_bwd(grid: Grid, with_alpha: bool, residuals, cotangents):
    return _by_platform(functools.partial(_backward, grid, with_alpha, residuals, cotangents)), None


def _backward(grid: Grid, with_alpha: bool, residuals, cotangents, schedule: Schedule):
    table, intersections, out = residuals
    tails = jnp.sum(out * cotangents, axis=1)

    def batch(grads, tiles):
        inside = jnp.minimum(tiles, grid.num_tiles - 1)
        cotangent = lax.optimization_barrier(jnp.moveaxis(cotangents[inside], 0, -1))  # co p t
        by_channel, by_alpha = (cotangent[:-1], cotangent[-1, :, None]) if with_alpha else (cotangent, 0.0)

        def step(rows, values, alphas, transmittance, state):
            tail, grads = state
            weights, afters = _weights(alphas, transmittance)
            weights = jnp.stack(weights, axis=1)
            channels = values[STEP_CHANNELS]
            dots = sum((c[:, None] * value for c, value in zip(by_channel, channels, strict=True)), by_alpha)
            tail, exponents = _exponent_gradients(alphas, weights, weights * dots, tail)
            grad_channels = [_sum_pixels(grid, weights * c[:, None]) for c in by_channel]
            grad_rows = jnp.stack([*_shape_gradients(grid, exponents, values), *grad_channels], axis=-1)
            grads = grads.at[rows.T].add(grad_rows)  # rows read behind a tile's end add zeros
            return afters[-1], (tail, grads)

        return _run_steps(grid, table, intersections, tiles, schedule, step, (tails[inside].T, grads))[1], None

    grads = jnp.zeros_like(table[:, binning.WITHOUT_BOX])
    grads = lax.scan(batch, grads, _batches(intersections.bounds, grid, schedule))[0]
    return jnp.pad(grads, ((0, 0), (0, table.shape[1] - grads.shape[1])))


composite.defvjp(_composite_fwd, _composite_bwd)


def median_rows(grid: Grid, table: Float[Array, "m f"], intersections: TileIntersections) -> Int[Array, "tiles p"]:
    """The table row whose sample brings each pixel's transmittance below one half, or -1; without a gradient."""
    return _by_platform(functools.partial(_median_rows, grid, table, intersections))


def _median_rows(grid: Grid, table, intersections: TileIntersections, schedule: Schedule):
    table = jnp.concatenate([table[:, binning.SHAPE], table[:, binning.BOX]], axis=1)

    def batch(tiles):
        def step(rows, _, alphas, transmittance, found):
            afters = _weights(alphas, transmittance)[1]
            for after, row in zip(afters, rows.T, strict=True):
                found = jnp.where((found < 0) & (after < constants.MEDIAN_TRANSMITTANCE), row, found)
            return afters[-1], found

        start = jnp.full((grid.tile**2, tiles.shape[0]), -1, jnp.int32)
        return _run_steps(grid, table, intersections, tiles, schedule, step, start)

    batches = _batches(intersections.bounds, grid, schedule)
    out = jnp.moveaxis(lax.map(batch, batches), -1, 1).reshape(-1, grid.tile**2)
    return jnp.full((grid.num_tiles, grid.tile**2), -1, jnp.int32).at[batches.reshape(-1)].set(out, mode="drop")


def _batches(bounds: Int[Array, " tiles_and_one"], grid: Grid, schedule: Schedule) -> Int[Array, "batches t"]:
    """Tiles in order of load, so that those of a batch end together; padded with `grid.num_tiles`, an invalid index."""
    order = jnp.argsort(bounds[1:] - bounds[:-1]).astype(jnp.int32)
    size = min(schedule.batch_size, grid.num_tiles)
    return jnp.pad(order, (-grid.num_tiles % size, 0), constant_values=grid.num_tiles).reshape(-1, size)


def _run_steps(
    grid: Grid,
    table,
    intersections: TileIntersections,
    tiles: Int[Array, " t"],
    schedule: Schedule,
    step: Callable,
    state,
    *,
    with_ones: bool = False,
):
    """`state` after all steps of a batch, front to back.

    A step's Gaussians are looked up, copied and transposed with `in_own_kernel`: XLA would otherwise fuse that with
    every kernel that uses them, and each would go through the table once a sample.

    `step(rows, values, alphas, transmittance, state)` returns the transmittance and the state after it; `rows` are row
    numbers of `table`, `values` their columns, followed by ones if `with_ones`. Steps go on while, in one of the tiles,
    Gaussians are left and a pixel is above the stop.
    """
    bounds, end = intersections.bounds, grid.num_tiles
    # Start and end of the pairs of each tile; equal for the padding of `_batches`.
    first, last = bounds[jnp.minimum(tiles, end)], bounds[jnp.minimum(tiles + 1, end)]
    size = schedule.step_size
    has_any = intersections.num_pairs > 0

    def goes_on(carry):
        i, transmittance = carry[:2]
        clearest = jnp.max(transmittance, axis=0)
        return jnp.any((clearest >= constants.TRANSMITTANCE_STOP) & (first + i * size < last))

    def body(carry):
        i, transmittance, state = carry
        start = first + i * size
        # Consecutive rows from each start, copied as blocks.
        next_rows = jax.vmap(lambda at: lax.dynamic_slice_in_dim(intersections.rows, at, size))
        rows = in_own_kernel(has_any, lambda: next_rows(start))
        gaussians = in_own_kernel(has_any, lambda: table[rows][..., binning.WITHOUT_BOX])
        values = in_own_kernel(has_any, lambda: _step_columns(grid, gaussians, tiles, start, last, with_ones))
        transmittance, state = step(rows, values, _alphas(grid, values), transmittance, state)
        return i + 1, transmittance, state

    clear = jnp.ones((grid.tile**2, tiles.shape[0]), table.dtype)
    return lax.while_loop(goes_on, body, (0, clear, state))[2]


def _step_columns(grid: Grid, gaussians: Float[Array, "t u f"], tiles, start, last, with_ones: bool):
    """Columns of a step's Gaussians, `[f u t]`: means from the tile's center, opacity 0 behind the tile's end."""
    x, y, p, q, r, log_opacity, *channels = jnp.moveaxis(gaussians, (2, 1, 0), (0, 1, 2))
    within = tiles % (grid.rows * grid.columns)
    x = x - ((within % grid.columns).astype(x.dtype) + 0.5) * grid.tile
    y = y - ((within // grid.columns).astype(x.dtype) + 0.5) * grid.tile
    is_own = start + jnp.arange(gaussians.shape[1], dtype=jnp.int32)[:, None] < last
    ones = [jnp.ones_like(x)] * with_ones
    return jnp.stack([x, y, p, q, r, jnp.where(is_own, log_opacity, -jnp.inf), *channels, *ones])


def _alphas(grid: Grid, values) -> Float[Array, "p u t"]:
    """Alphas of all samples; 0 where they are skipped."""
    side = jnp.arange(grid.tile, dtype=values.dtype) - (grid.tile - 1) / 2  # of pixels, from the tile's center
    dx = jnp.tile(side, grid.tile)[:, None, None] - values[binning.MEAN_X]
    dy = jnp.repeat(side, grid.tile)[:, None, None] - values[binning.MEAN_Y]
    p, q, r = values[binning.FACTORS]
    across, along = p * dx + q * dy, r * dy
    log_alpha = values[binning.LOG_OPACITY] - across * across - along * along
    is_drawn = log_alpha >= constants.LOG_ALPHA_MIN
    return short_exp(jnp.where(is_drawn, jnp.minimum(log_alpha, LOG_ALPHA_MAX), -jnp.inf), constants.LOG_ALPHA_MIN)


def _weights(alphas, transmittance):
    """Weights of a step's samples and the transmittance after each, `[p t]` for each Gaussian.

    The transmittance goes on falling below the stop, so that comparing it tells whether a pixel has ended.
    """
    weights, afters = [], []
    for u in range(alphas.shape[1]):
        weight = alphas[:, u] * transmittance
        transmittance = transmittance * (1.0 - alphas[:, u])
        weights.append(jnp.where(transmittance >= constants.TRANSMITTANCE_STOP, weight, 0.0))
        afters.append(transmittance)
    return weights, afters


def _exponent_gradients(alphas, weights, gains, tail):
    """The tail after the step, and dL/dq of every sample, where alpha = opacity exp(-q) before its limits.

    dL/dq = -a dL/da = -w s + a / (1 - a) tail; 0 for samples that are skipped, capped or behind the stop.
    """
    # Without the barrier XLA sees that alpha is a quotient, and computes its denominator again for the ratio.
    alphas, gains = lax.optimization_barrier((alphas, gains))
    tails = []
    for u in range(alphas.shape[1]):
        tail = tail - gains[:, u]
        tails.append(tail)
    last, tails = tails[-1], lax.optimization_barrier(jnp.stack(lax.optimization_barrier(tails), axis=1))
    free = (weights > 0) & (alphas < CAPPED_ALPHA)
    ratio = alphas / (1.0 - alphas)
    return last, lax.optimization_barrier(jnp.where(free, ratio * tails - gains, 0.0))


def _total(terms: Iterable[Array]) -> Array:
    """The sum of a few arrays, term by term, which XLA fuses into one kernel."""
    return functools.reduce(operator.add, terms)


def _sum_pixels(grid: Grid, values: Float[Array, "p u t"]) -> Float[Array, "u t"]:
    """Sums over the pixels of a tile, row by row."""
    return _total(jnp.sum(values.reshape(grid.tile, grid.tile, *values.shape[1:]), axis=1))


def _monomials(grid: Grid, dtype) -> Float[Array, "6 p"]:
    """1, X, Y, X^2, XY and Y^2 at the pixels of a tile, X and Y from its center."""
    side = np.arange(grid.tile) - (grid.tile - 1) / 2
    x, y = np.tile(side, grid.tile), np.repeat(side, grid.tile)
    return jnp.asarray(np.stack([np.ones_like(x), x, y, x * x, x * y, y * y]), dtype)


def _shape_gradients(grid: Grid, exponents: Float[Array, "p u t"], values) -> tuple[Float[Array, "u t"], ...]:
    """Gradients by the shape columns, from moments of the exponent gradients over the pixels.

    The exponent is s^2 + (r dy)^2 with s = p dx + q dy. The moments are taken about the tile's center, by one matrix
    product. There s is `center` + p X + q Y, which is small where a sample is drawn: the moments of s do not cancel,
    however long and thin the Gaussian is.
    """
    x, y = values[binning.MEAN_X], values[binning.MEAN_Y]
    p, q, r = values[binning.FACTORS]
    moments = jnp.einsum("mp,put->mut", _monomials(grid, exponents.dtype), exponents, precision="highest")
    one, by_x, by_y, by_xx, by_xy, by_yy = moments
    center = -(p * x + q * y)
    sum_s = center * one + p * by_x + q * by_y
    sum_sdx = center * by_x + p * by_xx + q * by_xy - x * sum_s
    sum_sdy = center * by_y + p * by_xy + q * by_yy - y * sum_s
    sum_dy = by_y - y * one
    sum_dydy = by_yy - y * by_y - y * sum_dy
    return -2.0 * p * sum_s, -2.0 * (q * sum_s + r * r * sum_dy), 2.0 * sum_sdx, 2.0 * sum_sdy, 2.0 * r * sum_dydy, -one
