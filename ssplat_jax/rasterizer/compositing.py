"""The fast path: tiles composited front to back in batches of similar load, with a gradient that recomputes.

A turn of the loop takes the next `TURN` Gaussians of each of `BATCH` tiles. Arrays are `[p u t]`: pixels of a tile,
then the turn's Gaussians, then the batch's tiles, so that every kernel runs over contiguous tiles with the pixel's
offset as a constant, and sums over Gaussians or pixels are sums over a short middle axis (XLA vectorizes those; sums
over the last or a long first axis cost five times as much). Nothing per sample is stored: the backward pass walks the
same turns again, front to back, knowing the totals from the forward pass.

    w_i = a_i T_i,  T_{i+1} = T_i (1 - a_i)        out = sum_i w_i c_i
    dL/da_i = T_i s_i - tail_i / (1 - a_i)   with s_i = c_i . dL/dout and tail_i = sum_{j>i} w_j s_j
"""

import functools
import math
import operator
from collections.abc import Callable, Iterable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from ssplat_jax.rasterizer import constants
from ssplat_jax.rasterizer.binning import READ_AHEAD, Pairs
from ssplat_jax.rasterizer.depth_sorted_table import BOX, SHAPE
from ssplat_jax.rasterizer.tile_grid import Grid
from ssplat_jax.xla_cpu import apart

TURN = READ_AHEAD  # the last of a tile may look past all pairs
BATCH = 128
LOG_LEAST = constants.LOG_ALPHA_MIN
LOG_MOST = math.log(constants.ALPHA_MAX)
CAPPED = constants.ALPHA_MAX * (1 - 1e-5)  # no less is what exp(LOG_MOST) comes out as
SQUARINGS = 3
# e^y of an eighth of what an alpha's power can be, a polynomial
GROWTH = np.polynomial.Chebyshev.interpolate(np.exp, 5, [0.0, -LOG_LEAST / 2**SQUARINGS]).convert(
    kind=np.polynomial.Polynomial
)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def composite(grid: Grid, with_alpha: bool, table: Float[Array, "m f"], pairs: Pairs) -> Float[Array, "tiles co p"]:
    """The channels of a `sorted_table`, and alpha behind them if wanted, composited over every tile's pixels.

    Gradients reach the columns of the shape and the channels. Samples fainter than 1/255 or capped at 0.99 pass none on
    to their opacity.
    """
    return _forward(grid, with_alpha, table, pairs)


def _forward(grid: Grid, with_alpha: bool, table, pairs: Pairs):
    num_channels = table.shape[1] - SHAPE - BOX + with_alpha  # alpha is what a channel of ones becomes

    def batch(out, tiles):
        def turn(_, values, alphas, transmittance, out):
            weights, afters = _weights(alphas, transmittance)
            return afters[-1], out + _total(weight * values[SHAPE:, None, u] for u, weight in enumerate(weights))

        start = jnp.zeros((num_channels, grid.tile**2, tiles.shape[0]), table.dtype)
        drawn = _walk(grid, table, pairs, tiles, turn, start, with_ones=with_alpha)
        return out.at[tiles].set(jnp.moveaxis(drawn, -1, 0), mode="drop"), None

    out = jnp.zeros((grid.num_tiles, num_channels, grid.tile**2), table.dtype)
    return lax.scan(batch, out, _batches(pairs.bounds, grid))[0]


def _composite_fwd(grid: Grid, with_alpha: bool, table, pairs: Pairs):
    out = _forward(grid, with_alpha, table, pairs)
    return out, (table, pairs, out)


def _composite_bwd(grid: Grid, with_alpha: bool, residuals, cotangents):
    table, pairs, out = residuals
    tails = jnp.sum(out * cotangents, axis=1)

    def batch(grads, tiles):
        inside = jnp.minimum(tiles, grid.num_tiles - 1)
        cotangent = lax.optimization_barrier(jnp.moveaxis(cotangents[inside], 0, -1))  # co p t
        by_channel, by_alpha = (cotangent[:-1], cotangent[-1, :, None]) if with_alpha else (cotangent, 0.0)

        def turn(numbers, values, alphas, transmittance, state):
            tail, grads = state
            weights, afters = _weights(alphas, transmittance)
            weights = jnp.stack(weights, axis=1)
            slopes = sum((c[:, None] * value for c, value in zip(by_channel, values[SHAPE:], strict=True)), by_alpha)
            tail, exponents = _exponent_gradients(alphas, weights, weights * slopes, tail)
            grad_channels = [_sum_pixels(grid, weights * c[:, None]) for c in by_channel]
            rows = jnp.stack([*_shape_gradients(grid, exponents, values), *grad_channels], axis=-1)
            grads = grads.at[numbers.T].add(rows)  # what is read past a tile's end adds zeros
            return afters[-1], (tail, grads)

        return _walk(grid, table, pairs, tiles, turn, (tails[inside].T, grads))[1], None

    grads = jnp.zeros((table.shape[0], table.shape[1] - BOX), table.dtype)
    grads = lax.scan(batch, grads, _batches(pairs.bounds, grid))[0]
    return jnp.pad(grads, ((0, 0), (0, BOX))), None


composite.defvjp(_composite_fwd, _composite_bwd)


def median_rows(grid: Grid, table: Float[Array, "m f"], pairs: Pairs) -> Int[Array, "tiles p"]:
    """The row of a `sorted_table` whose sample brings each pixel's transmittance below one half, or -1.

    No gradient.
    """
    table = jnp.concatenate([table[:, :SHAPE], table[:, -BOX:]], axis=1)

    def batch(tiles):
        def turn(numbers, _, alphas, transmittance, found):
            afters = _weights(alphas, transmittance)[1]
            for after, row in zip(afters, numbers.T, strict=True):
                found = jnp.where((found < 0) & (after < constants.MEDIAN_TRANSMITTANCE), row, found)
            return afters[-1], found

        return _walk(grid, table, pairs, tiles, turn, jnp.full((grid.tile**2, tiles.shape[0]), -1, jnp.int32))

    batches = _batches(pairs.bounds, grid)
    out = jnp.moveaxis(lax.map(batch, batches), -1, 1).reshape(-1, grid.tile**2)
    return jnp.full((grid.num_tiles, grid.tile**2), -1, jnp.int32).at[batches.reshape(-1)].set(out, mode="drop")


def _batches(bounds: Int[Array, " tiles_and_one"], grid: Grid) -> Int[Array, "batches t"]:
    """Tiles in order of load, so that those of a batch end together; padded with tile numbers beyond the last."""
    order = jnp.argsort(bounds[1:] - bounds[:-1]).astype(jnp.int32)
    size = min(BATCH, grid.num_tiles)
    padding = -grid.num_tiles % size
    order = jnp.concatenate([jnp.full((padding,), grid.num_tiles, jnp.int32), order])
    return order.reshape(-1, size)


def _loads(pairs: Pairs, tiles: Int[Array, " t"]) -> tuple[Int[Array, " t"], Int[Array, " t"]]:
    """Where the pairs of `tiles` begin and end; a tile number beyond the last has none."""
    last = pairs.bounds.shape[0] - 1
    return pairs.bounds[jnp.minimum(tiles, last)], pairs.bounds[jnp.minimum(tiles + 1, last)]


def _walk(grid: Grid, table, pairs: Pairs, tiles: Int[Array, " t"], turn: Callable, state, *, with_ones: bool = False):
    """`state` after all turns of a batch, front to back.

    `turn(numbers, values, alphas, transmittance, state)` gives the transmittance and the state after it; `numbers` are
    rows of `table`. There is another turn while, in one of the tiles, Gaussians are left and a pixel that one could
    reach.

    A turn's Gaussians are looked up, copied and laid in columns `apart`: XLA would otherwise fuse that with every
    kernel that uses them, and each would go through the table once a sample (docs/performance.md).
    """
    first, last = _loads(pairs, tiles)
    some = pairs.num_pairs > 0

    def goes_on(carry):
        i, transmittance = carry[:2]
        clearest = jnp.max(transmittance, axis=0)
        return jnp.any((clearest >= constants.TRANSMITTANCE_STOP) & (first + i * TURN < last))

    def body(carry):
        i, transmittance, state = carry
        start = first + i * TURN
        numbers = apart(some, lambda: _next(pairs.rows, start))
        gaussians = apart(some, lambda: table[numbers][..., :-BOX])
        values = apart(some, lambda: _columns(grid, gaussians, tiles, start, last, with_ones))
        transmittance, state = turn(numbers, values, _alphas(grid, values), transmittance, state)
        return i + 1, transmittance, state

    clear = jnp.ones((grid.tile**2, tiles.shape[0]), table.dtype)
    return lax.while_loop(goes_on, body, (0, clear, state))[2]


def _next(rows: Array, start: Int[Array, " t"]) -> Array:
    """`TURN` consecutive rows from each start, `[t u ...]`: copied as blocks."""
    return jax.vmap(lambda first: lax.dynamic_slice_in_dim(rows, first, TURN))(start)


def _columns(grid: Grid, gaussians: Float[Array, "t u f"], tiles, start, last, with_ones: bool):
    """A turn's Gaussians, `[f u t]`: x and y from the tile's center, no opacity past a tile's end, ones if wanted."""
    x, y, p, q, r, log_opacity, *channels = jnp.moveaxis(gaussians, (2, 1, 0), (0, 1, 2))
    within = tiles % (grid.rows * grid.columns)
    x = x - ((within % grid.columns).astype(x.dtype) + 0.5) * grid.tile
    y = y - ((within // grid.columns).astype(x.dtype) + 0.5) * grid.tile
    is_own = start + jnp.arange(TURN, dtype=jnp.int32)[:, None] < last
    ones = [jnp.ones_like(x)] * with_ones
    return jnp.stack([x, y, p, q, r, jnp.where(is_own, log_opacity, -jnp.inf), *channels, *ones])


def _offsets(grid: Grid, values) -> tuple[Float[Array, "p u t"], Float[Array, "p u t"]]:
    """dx and dy of every sample: its pixel's center from the Gaussian's."""
    side = jnp.arange(grid.tile, dtype=values.dtype) - (grid.tile - 1) / 2  # from the tile's center
    return jnp.tile(side, grid.tile)[:, None, None] - values[0], jnp.repeat(side, grid.tile)[:, None, None] - values[1]


def _alphas(grid: Grid, values) -> Float[Array, "p u t"]:
    dx, dy = _offsets(grid, values)
    p, q, r, log_opacity = values[2:6]
    across, along = p * dx + q * dy, r * dy
    power = log_opacity - across * across - along * along
    return _exp(jnp.where(power >= LOG_LEAST, jnp.minimum(power, LOG_MOST), -jnp.inf))


def _exp(power: Array) -> Array:
    """e^power of powers from `LOG_LEAST` to 0 to 3e-6 of itself (float64: exactly), and 0 of minus infinity.

    On that short range, a polynomial of an eighth of it and three squarings take two thirds of the time of XLA's
    exponential. XLA's CPU compiler keeps what comes out of a division, as it does of an exponential: every kernel would
    otherwise compute the alphas again.
    """
    if power.dtype == jnp.float64:
        return jnp.exp(power)
    eighth = power * (-1.0 / 2**SQUARINGS)
    growth = jnp.asarray(GROWTH.coef[-1], power.dtype)
    for coefficient in GROWTH.coef[-2::-1]:
        growth = growth * eighth + float(coefficient)
    for _ in range(SQUARINGS):
        growth = growth * growth
    return 1.0 / growth


def _weights(alphas, transmittance):
    """Weights of a turn's samples and the transmittance after each, `[p t]` a Gaussian.

    The transmittance runs on below the stop: it only ever falls, so comparing it needs no flag that a pixel has ended.
    """
    weights, afters = [], []
    for u in range(alphas.shape[1]):
        weight = alphas[:, u] * transmittance
        transmittance = transmittance * (1.0 - alphas[:, u])
        weights.append(jnp.where(transmittance >= constants.TRANSMITTANCE_STOP, weight, 0.0))
        afters.append(transmittance)
    return weights, afters


def _exponent_gradients(alphas, weights, gains, tail):
    """The tail after the turn, and dL/dq of every sample, where raw = opacity exp(-q).

    dL/dq = -a dL/da = -w s + a / (1 - a) tail; 0 for samples that are skipped, capped or beyond the stop.
    """
    gains = lax.optimization_barrier(gains)
    tails = []
    for u in range(alphas.shape[1]):
        tail = tail - gains[:, u]
        tails.append(tail)
    last, tails = tails[-1], lax.optimization_barrier(jnp.stack(lax.optimization_barrier(tails), axis=1))
    free = (weights > 0) & (alphas < CAPPED)
    ratio = alphas / (1.0 - alphas)
    return last, lax.optimization_barrier(jnp.where(free, ratio * tails - gains, 0.0))


def _sum_rows(grid: Grid, values: Float[Array, "p u t"]) -> Float[Array, "rows u t"]:
    """Sums over each row of pixels of a tile."""
    rows = values.reshape(grid.tile, grid.tile, *values.shape[1:])
    return jnp.sum(rows, axis=1)


def _total(terms: Iterable[Array]) -> Array:
    """The sum of a few arrays, term by term: one fused kernel."""
    return functools.reduce(operator.add, terms)


def _sum_pixels(grid: Grid, values: Float[Array, "p u t"]) -> Float[Array, "u t"]:
    """Sums over the pixels of a tile."""
    return _total(_sum_rows(grid, values))


def _shape_gradients(grid: Grid, exponents: Float[Array, "p u t"], values) -> list[Float[Array, "u t"]]:
    """Gradients by x, y, p, q, r and the opacity's logarithm, from moments of the exponent gradients over the pixels.

    The exponent is s^2 + (r dy)^2 with s = p dx + q dy, which the moments hold as it is: made of those of dx and dy, it
    would cancel for needles.
    """
    p, q, r = values[2:5]
    dx, dy = _offsets(grid, values)
    across = p * dx + q * dy
    rows, rows_s, rows_sdx = (_sum_rows(grid, exponents * weight) for weight in (1.0, across, across * dx))
    dys = dy[:: grid.tile]  # one a row
    sum_s, sum_sdx = _total(rows_s), _total(rows_sdx)
    sum_sdy = _total(row * dy for row, dy in zip(rows_s, dys, strict=True))
    sum_dy = _total(row * dy for row, dy in zip(rows, dys, strict=True))
    sum_dydy = _total(row * dy * dy for row, dy in zip(rows, dys, strict=True))
    return [
        -2.0 * p * sum_s,
        -2.0 * (q * sum_s + r * r * sum_dy),
        2.0 * sum_sdx,
        2.0 * sum_sdy,
        2.0 * r * sum_dydy,
        -_total(rows),
    ]
