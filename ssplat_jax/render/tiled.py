"""The fast path: tiles composited front to back in batches of similar load, with a gradient that recomputes.

A turn of the loop takes the next `TURN` Gaussians of each of `BATCH` tiles. Arrays are `[p u t]`: pixels of a tile, then
the turn's Gaussians, then the batch's tiles, so that every kernel runs over contiguous tiles with the pixel's offset as
a constant, and sums over Gaussians or pixels are sums over a short middle axis (XLA vectorises those; sums over the last
or a long first axis cost five times as much). Nothing per pair is stored: the backward pass walks the same turns again,
front to back, knowing the totals from the forward pass.

    w_i = a_i T_i,  T_{i+1} = T_i (1 - a_i)        out = sum_i w_i c_i
    dL/da_i = T_i s_i - tail_i / (1 - a_i)   with s_i = c_i . dL/dout and tail_i = sum_{j>i} w_j s_j
"""

import functools

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from ssplat_jax.render import constants
from ssplat_jax.render.binning import Grid, Pairs

TURN = 8
BATCH = 64


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def composite(
    grid: Grid, shapes: Float[Array, "m 6"], channels: Float[Array, "m c"], pairs: Pairs
) -> Float[Array, "tiles c p"]:
    """Channels composited over the pixels of every tile; `shapes` are (x, y, conic xx, xy, yy, opacity).

    Gradients reach `shapes` and `channels`. Samples fainter than 1/255 or capped at 0.99 pass none on to their opacity.
    """
    return _forward(grid, shapes, channels, pairs)


def _forward(grid: Grid, shapes, channels, pairs: Pairs):
    table = _padded_table(shapes, channels)

    def batch(tiles):
        first, last = _loads(pairs, tiles)

        def turn(carry):
            i, transmittance, out = carry
            _, values, alphas = _turn(grid, table, pairs.rows, tiles, first + i * TURN, last)
            weights, _, transmittance = _weights(alphas, transmittance)
            weights = jnp.stack(weights, axis=1)
            out = [o + jnp.sum(weights * value, axis=1) for o, value in zip(out, values[6:], strict=True)]
            return i + 1, transmittance, out

        blank = jnp.zeros((grid.tile**2, tiles.shape[0]), shapes.dtype)
        start = (0, blank + 1, [blank] * channels.shape[1])
        return jnp.stack(lax.while_loop(_goes_on(first, last), turn, start)[2])

    batches = _batches(pairs.bounds, grid)
    out = jnp.moveaxis(lax.map(batch, batches), -1, 1).reshape(-1, channels.shape[1], grid.tile**2)
    return jnp.zeros((grid.num_tiles, *out.shape[1:]), out.dtype).at[batches.reshape(-1)].set(out, mode="drop")


def _composite_fwd(grid: Grid, shapes, channels, pairs: Pairs):
    out = _forward(grid, shapes, channels, pairs)
    return out, (shapes, channels, pairs, out)


def _composite_bwd(grid: Grid, residuals, cotangents):
    shapes, channels, pairs, out = residuals
    table = _padded_table(shapes, channels)
    tails = jnp.sum(out * cotangents, axis=1)

    def batch(grads, tiles):
        first, last = _loads(pairs, tiles)
        inside = jnp.minimum(tiles, grid.num_tiles - 1)
        cotangent = lax.optimization_barrier(jnp.moveaxis(cotangents[inside], 0, -1))  # c p t

        def turn(carry):
            i, transmittance, tail, grads = carry
            ids, values, alphas = _turn(grid, table, pairs.rows, tiles, first + i * TURN, last)
            weights, afters, transmittance = _weights(alphas, transmittance)
            weights = jnp.stack(weights, axis=1)
            slopes = sum(c[:, None] * value for c, value in zip(cotangent, values[6:], strict=True))
            tail, exponents = _exponent_gradients(alphas, weights, weights * slopes, afters, tail)
            grad_channels = [_sum_pixels(grid, weights * c[:, None]) for c in cotangent]
            rows = jnp.stack([*_shape_gradients(grid, exponents, values), *grad_channels], axis=-1)
            return i + 1, transmittance, tail, grads.at[ids].add(rows)

        start = (0, jnp.ones((grid.tile**2, tiles.shape[0]), shapes.dtype), tails[inside].T, grads)
        return lax.while_loop(_goes_on(first, last), turn, start)[3], None

    grads = lax.scan(batch, jnp.zeros_like(table), _batches(pairs.bounds, grid))[0][:-1]
    return grads[:, :6], grads[:, 6:], None


composite.defvjp(_composite_fwd, _composite_bwd)


def _padded_table(shapes, channels) -> Float[Array, "m_and_one f"]:
    """One row a Gaussian, and a last row that is nothing, for the turns beyond a tile's end."""
    return jnp.pad(jnp.concatenate([shapes, channels], axis=1), ((0, 1), (0, 0)))


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


def _goes_on(first, last):
    """Whether a batch has another turn: Gaussians are left, and a pixel that one could still reach."""
    turns = (jnp.max(last - first) + TURN - 1) // TURN
    return lambda carry: (carry[0] < turns) & jnp.any(carry[1] >= constants.TRANSMITTANCE_STOP)


def _pixel_offsets(grid: Grid, dtype) -> tuple[Float[Array, " p"], Float[Array, " p"]]:
    """Pixel centres from the centre of their tile."""
    offsets = jnp.arange(grid.tile, dtype=dtype) - (grid.tile - 1) / 2
    return jnp.tile(offsets, grid.tile), jnp.repeat(offsets, grid.tile)


def _turn(grid: Grid, table, rows, tiles, start, last):
    """The next `TURN` Gaussians of each tile: rows of the table, its columns (x, y from the tile's centre), opacities."""
    position = start + jnp.arange(TURN, dtype=jnp.int32)[:, None]
    nothing = table.shape[0] - 1
    ids = jnp.where(position < last, rows[jnp.minimum(position, rows.shape[0] - 1)], nothing)
    # A stack is a copy that XLA does not fuse away: the kernels below then read columns, not strided rows.
    columns = jnp.stack(list(jnp.moveaxis(table[ids], -1, 0)))
    x, y, conic_xx, conic_xy, conic_yy, opacity, *channels = columns
    within = tiles % (grid.rows * grid.columns)
    x -= ((within % grid.columns).astype(x.dtype) + 0.5) * grid.tile
    y -= ((within // grid.columns).astype(x.dtype) + 0.5) * grid.tile
    offset_x, offset_y = (o[:, None, None] for o in _pixel_offsets(grid, x.dtype))
    dx, dy = offset_x - x, offset_y - y
    raw = opacity * jnp.exp(-(0.5 * (conic_xx * dx * dx + conic_yy * dy * dy) + conic_xy * dx * dy))
    alphas = jnp.where(raw >= constants.ALPHA_MIN, jnp.minimum(raw, constants.ALPHA_MAX), 0.0)
    return ids, [x, y, conic_xx, conic_xy, conic_yy, opacity, *channels], alphas


def _weights(alphas, transmittance):
    """Weights of a turn's samples, the transmittance after each, and after all.

    The transmittance runs on below the stop: it only ever falls, so comparing it needs no flag that a pixel has ended.
    """
    weights, afters = [], []
    for u in range(alphas.shape[1]):
        weight = alphas[:, u] * transmittance
        transmittance = transmittance - weight
        weights.append(jnp.where(transmittance >= constants.TRANSMITTANCE_STOP, weight, 0.0))
        afters.append(transmittance)
    return weights, afters, afters[-1]


def _exponent_gradients(alphas, weights, gains, afters, tail):
    """The tail after the turn, and dL/dq of every sample, where raw = opacity exp(-q).

    dL/dq = -a dL/da = -w s + a / (1 - a) tail; 0 for samples that are skipped, capped or beyond the stop.
    """
    gains = lax.optimization_barrier(gains)
    tails = []
    for u in range(alphas.shape[1]):
        tail = tail - gains[:, u]
        tails.append(tail)
    last, tails = tails[-1], lax.optimization_barrier(jnp.stack(lax.optimization_barrier(tails), axis=1))
    free = (weights > 0) & (alphas < constants.ALPHA_MAX)
    ratio = alphas / (1.0 - alphas)
    return last, lax.optimization_barrier(jnp.where(free, ratio * tails - gains, 0.0))


def _sum_rows(grid: Grid, values: Float[Array, "p u t"]) -> Float[Array, "rows u t"]:
    """Sums over each row of pixels of a tile."""
    rows = values.reshape(grid.tile, grid.tile, *values.shape[1:])
    return jnp.sum(rows, axis=1)


def _sum_pixels(grid: Grid, values: Float[Array, "p u t"]) -> Float[Array, "u t"]:
    """Sums over the pixels of a tile."""
    return sum(_sum_rows(grid, values))


def _shape_gradients(grid: Grid, exponents: Float[Array, "p u t"], values) -> list[Float[Array, "u t"]]:
    """Gradients by (x, y, conic xx, xy, yy, opacity), from moments of the exponent's gradient over the tile's pixels."""
    x, y, conic_xx, conic_xy, conic_yy, opacity = values[:6]
    offsets_x, _ = _pixel_offsets(grid, exponents.dtype)
    dx = offsets_x[:, None, None] - x
    rows = [_sum_rows(grid, exponents), _sum_rows(grid, exponents * dx), _sum_rows(grid, exponents * dx * dx)]
    dys = [(j - (grid.tile - 1) / 2) - y for j in range(grid.tile)]
    total = sum(rows[0])
    sum_dx, sum_dxdx = sum(rows[1]), sum(rows[2])
    sum_dy = sum(row * dy for row, dy in zip(rows[0], dys, strict=True))
    sum_dxdy = sum(row * dy for row, dy in zip(rows[1], dys, strict=True))
    sum_dydy = sum(row * dy * dy for row, dy in zip(rows[0], dys, strict=True))
    return [
        -(conic_xx * sum_dx + conic_xy * sum_dy),
        -(conic_xy * sum_dx + conic_yy * sum_dy),
        0.5 * sum_dxdx,
        sum_dxdy,
        0.5 * sum_dydy,
        -total / jnp.where(opacity > 0, opacity, 1.0),
    ]
