"""Observations: how often views saw a pivot, saw through it or did not see it, and how well its color fitted there.

This is an addition to the paper's VACC: a feature that was written with its token does not know which pivots later
views confirm. A pivot projects to a cell of each of a chunk's views. If the depth of the cell is trusted, it tells
whether the pivot lies on the cell's surface, before it or behind it, and how far from it, how well its color fits, and
how many other pivots share the cell. The cache keeps the sums of these numbers over all views since the pivot was
written, and the decoder reads them (`model/evidence.py`).
"""

import functools
import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ssplat_jax.cache.project import PixelPairs, fold_pairs, places_of, rows_in_sight, rows_of
from ssplat_jax.cache.state import VoxelCache
from ssplat_jax.cache.votes import is_trusted
from ssplat_jax.config import StreamConfig
from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.cpu_backend import kept
from ssplat_jax.core.numerics import safe_log
from ssplat_jax.core.pytree import pytree, replace

ON_SURFACE = math.log(1.03)
"""Largest distance in log depth at which a pivot lies on the surface of a cell."""


@pytree
class SeenCells:
    """Cells of a chunk's views, flat over all views."""

    weights: Float[Array, " c"]  # confidence of the depth; 0 for a cell without a trusted one
    log_depths: Float[Array, " c"]
    colors: Float[Array, "c 3"]  # at the exposure of the scene


@pytree
class _Pairs:
    """Pairs of view and pivot of a block of rows, `[v, n]`."""

    weights: Float[Array, "v n"]  # of the cell
    offsets: Float[Array, "v n"]  # log depth of the pivot less the cell's, in units of `ON_SURFACE`
    on: Float[Array, "v n"]  # 1 where the pivot lies on the surface of a trusted cell, else 0
    errors: Float[Array, "v n"]  # mean absolute difference of the colors
    sizes: Float[Array, "v n"]  # log of the pivot's footprint over the cell's


def seen_cells(
    depths: Float[Array, "v hf wf"],
    confidences: Float[Array, "v hf wf"],
    rgbs: Float[Array, "m a"],
    config: StreamConfig,
) -> SeenCells:
    """Cells of a chunk whose tokens have the colors `rgbs`, view-major, row-major; trusted as in `carve`."""
    trusted = is_trusted(depths, confidences, config)
    return SeenCells(
        weights=jnp.where(trusted, confidences, 0.0).reshape(-1),
        log_depths=safe_log(jnp.where(trusted, depths, 1.0)).reshape(-1),
        colors=rgbs.reshape(len(rgbs), -1, 3).mean(axis=1),
    )


def observe(
    cache: VoxelCache, camera: Camera, cells: SeenCells, config: StreamConfig, *, axis: str | None = None
) -> VoxelCache:
    """`cache` with what the views of one chunk say about its pivots added to their observations.

    Args:
        cache: the cache after the chunk was fused; it keeps observations.
        camera: the chunk's views at grid resolution.
        cells: depths, confidences and colors of their cells.
        config: pivots below its `min_confidence` do not count as others in a cell.
        axis: name of the mapped axis over which the cache is sharded by voxel; None if `cache` is the whole cache.

    Returns:
        The cache; only `observations` differs.

    Limits:
        Cells of weight 0 add nothing. Pivots that no trusted cell sees keep their observations to the last bit.
    """
    num_cells, in_sight = cells.weights.shape[0], rows_in_sight(cache, camera)
    read = functools.partial(_read_cells, cache, camera, cells)

    def crowd(sums, pairs: PixelPairs, rows, is_row):
        seen = read(pairs, rows)
        on = jnp.where(pairs.weights >= config.memory.min_confidence, seen.on.reshape(-1), 0.0)
        return sums.at[pairs.pixels].add(jnp.stack([on, on * seen.errors.reshape(-1)], axis=-1), mode="drop")

    sums = fold_pairs(cache, camera, in_sight, crowd, jnp.zeros((num_cells, 2)))
    others, errors = (sums if axis is None else jax.lax.psum(sums, axis)).T
    others = jnp.maximum(others, 1.0)
    table = jnp.stack([jnp.log(others), errors / others], axis=-1)

    def add(observations, pairs: PixelPairs, rows, is_row):
        seen = read(pairs, rows)
        others = table.at[pairs.pixels].get(mode="fill", fill_value=0.0).reshape(*seen.weights.shape, 2)
        others = kept(others, cache.num_voxels >= 0)
        on = seen.weights * seen.on
        before = jnp.where(seen.offsets < -1, seen.weights, 0.0)
        sums = (
            on,
            before,
            jnp.where(seen.offsets > 1, seen.weights, 0.0),
            on * seen.errors,
            before * seen.errors,
            on * seen.offsets,
            on * others[..., 0],
            on * (seen.errors - others[..., 1]),
            on * seen.sizes,
        )
        new = jnp.stack([x.sum(axis=0) for x in sums], axis=-1).reshape(len(rows), *observations.shape[1:])
        return observations.at[places_of(rows, is_row, cache)].add(new, mode="drop")

    return replace(cache, observations=fold_pairs(cache, camera, in_sight, add, cache.observations))


def _read_cells(cache: VoxelCache, camera: Camera, cells: SeenCells, pairs: PixelPairs, rows: Int[Array, " n"]):
    """Contents of the cells into which `pairs` fall, compared with the pivots of `rows`; zeros for pivots not seen."""
    num_views, always = len(camera.viewmats), cache.num_voxels >= 0
    flat = lambda x: rows_of(x, rows).reshape(-1, *x.shape[2:])  # noqa: E731
    table = jnp.concatenate([cells.weights[:, None], cells.log_depths[:, None], cells.colors], axis=1)
    held = table.at[pairs.pixels].get(mode="fill", fill_value=0.0)
    held, log_depths = kept((held.reshape(num_views, -1, 5), pairs.log_depths.reshape(num_views, -1)), always)
    rgbs = flat(cache.rgbs)
    colors = kept(rgbs.reshape(len(rgbs), -1, 3).mean(axis=1), always)
    weights = held[..., 0]
    keep = lambda x: jnp.where(weights > 0, x, 0.0)  # noqa: E731
    offsets = keep((log_depths - held[..., 1]) / ON_SURFACE)
    return _Pairs(
        weights=weights,
        offsets=offsets,
        on=jnp.where((weights > 0) & (jnp.abs(offsets) <= 1), 1.0, 0.0),
        errors=keep(jnp.abs(held[..., 2:] - colors).mean(axis=-1)),
        sizes=keep(safe_log(flat(cache.footprints)) - log_depths + jnp.log(camera.Ks[:, 0, 0])[:, None]),
    )


def total_weight(observations: Float[Array, "*n s"]) -> Float[Array, "*n"]:
    """Weight of all cells that told something about a pivot: it grows whenever its observations change."""
    return observations[..., :3].sum(axis=-1)


def observation_features(observations: Float[Array, "n s"]) -> Float[Array, "n f"]:
    """Observations as numbers of about unit size: logarithms of the counts, shares, and means.

    Limits:
        Zeros, as for a pivot that no trusted cell has seen, give finite features. No gradient flows to observations.
    """
    on, before, behind, error_on, error_before, offset, crowd, relative, size = jnp.moveaxis(
        jax.lax.stop_gradient(observations), -1, 0
    )
    total, times_on = jnp.maximum(on + before + behind, 1e-3), jnp.maximum(on, 1e-3)
    error = (error_on + error_before) / jnp.maximum(on + before, 1e-3)
    features = (
        jnp.log1p(on) - 1.5,
        jnp.log1p(before) - 0.5,
        jnp.log1p(behind) - 0.5,
        4 * (before / total - 0.15),
        4 * (behind / total - 0.15),
        safe_log(0.01 + error_on / times_on) + 3.0,
        safe_log(0.01 + error) + 3.0,
        3 * offset / times_on,
        crowd / times_on - 1.0,
        20 * relative / times_on,
        size / times_on,
    )
    return jnp.stack(features, axis=-1)
