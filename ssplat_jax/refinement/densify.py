"""Densification: new Gaussians in the holes that key views show, at the depth of the surfaces around them.

each view ─► render ─► holes: cells that let light through, with a color, and the depth of what surrounds them
                           │
new Gaussians ◄─ holes that no new Gaussian fills yet, unless the new one would hide what other views show

A stream leaves holes where views did not match, and gradients only reach Gaussians that are there.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ssplat_jax.cache.key_views import KeyViews
from ssplat_jax.core.cameras import Camera, invert_poses, pixel_grid, project_points, transform_points, unproject
from ssplat_jax.core.gaussians import Gaussians, with_sh_degree
from ssplat_jax.core.pytree import pytree
from ssplat_jax.core.rotations import matrices_to_quats
from ssplat_jax.rasterizer import Effects, render
from ssplat_jax.refinement.compared_views import held_back_pixels
from ssplat_jax.refinement.refine_config import RefineConfig

CELL = 4  # side of a cell of pixels, which one new Gaussian covers
MIN_LIGHT = 0.5  # share of the light that must pass through a cell to make it a hole
REACHES = (2, 6)  # cells around a hole in which a surface is looked for; the farther ones where the near are empty
IN_FRONT = 0.9  # a point nearer than this fraction of a view's depth hides what the view shows there
MAX_HIDING = 0.1  # largest share of the views of a place in which a new Gaussian may hide a surface: depths err
OPACITY = 0.7  # of a new Gaussian
THICKNESS = 0.1  # standard deviation of a new Gaussian along the ray, as a fraction of that across


@pytree
class Cells:
    """The images of key views by cells of `CELL` x `CELL` pixels."""

    light: Float[Array, "*v hc wc"]  # share that passes through the scene
    colors: Float[Array, "*v hc wc 3"]  # color behind the scene that explains the image, in the scene's exposure
    depths: Float[Array, "*v hc wc"]  # camera z of what covers the cell, or of what surrounds it; 0 if unknown


def add_gaussians(
    gaussians: Gaussians, key_views: KeyViews, config: RefineConfig, max_pairs: int
) -> tuple[Gaussians, int]:
    """The scene with new Gaussians in its holes, at most `config.max_new` of those present, and their number.

    They take the places of absent rows, and then places after the last row. Call it outside jit.
    """
    is_present = np.asarray(gaussians.opacities) > 0
    max_new, num_rows = int(config.max_new * is_present.sum()), len(is_present)
    new, count = _densify(gaussians, key_views, config, max_pairs, max_new)
    num_new = int(count)
    places = np.concatenate([np.flatnonzero(~is_present), num_rows + np.arange(num_new)])[:num_new]
    num_missing = max(int(places.max(initial=-1)) + 1 - num_rows, 0)

    def put(given: Array, added: Array) -> Array:
        padded = jnp.concatenate([given, jnp.zeros((num_missing, *given.shape[1:]), given.dtype)])
        return padded.at[places].set(added[:num_new])

    return jax.tree.map(put, gaussians, new), num_new


@functools.partial(jax.jit, static_argnames=("config", "max_pairs", "max_new"))
def _densify(gaussians: Gaussians, key_views: KeyViews, config: RefineConfig, max_pairs: int, max_new: int):
    """New Gaussians `[max_new]` in the holes of all views, and how many there are: the first ones.

    A hole is a cell of which at least half of the light passes through the scene. Its Gaussian faces the camera, at the
    mean depth of the surroundings, weighted by depth: a gap mostly shows the surface behind. A view in which
    `max_pairs` do not suffice shows no hole, and holes of later views stay where `max_new` is full.
    """
    slots = jnp.arange(key_views.num_slots)
    cells = jax.lax.map(lambda slot: cells_of_view(gaussians, key_views, slot, config, max_pairs), slots)
    shape = cells.light.shape[1:]

    def add_view(so_far: tuple[Gaussians, Array], slot: Int[Array, ""]):
        new, num_new = so_far
        own, camera = jax.tree.map(lambda x: x[slot], cells), key_views.camera(slot)
        candidates = with_sh_degree(gaussians_of_cells(own, camera), gaussians.sh_degree)
        inside, rows, columns, _ = _cells_of_points(new.means, camera, shape)
        marks = jnp.where(inside & (new.opacities > 0), rows, shape[0])
        filled = jnp.zeros(shape, bool).at[marks, columns].set(True, mode="drop")  # and the cells beside them:
        filled = jax.lax.reduce_window(filled, False, jax.lax.bitwise_or, (3, 3), (1, 1), "SAME")
        is_new = key_views.valid[slot] & (own.light >= MIN_LIGHT) & (own.depths > 0) & ~filled
        is_new = is_new.reshape(-1) & ~hides(candidates.means, cells, key_views)
        for leaf in jax.tree.leaves(candidates):
            is_new &= jnp.all(jnp.isfinite(leaf.reshape(len(leaf), -1)), axis=1)
        places = jnp.where(is_new, num_new + jnp.cumsum(is_new, dtype=jnp.int32) - 1, max_new)
        new = jax.tree.map(lambda x, y: x.at[places].set(y, mode="drop"), new, candidates)
        return (new, jnp.minimum(num_new + jnp.sum(is_new, dtype=jnp.int32), max_new)), None

    none = jax.tree.map(lambda x: jnp.zeros((max_new, *x.shape[1:]), x.dtype), gaussians)
    return jax.lax.scan(add_view, (none, jnp.zeros((), jnp.int32)), slots)[0]


def cells_of_view(
    gaussians: Gaussians, key_views: KeyViews, slot: Int[Array, ""], config: RefineConfig, max_pairs: int
) -> Cells:
    """Holes of a key view, their colors, and depths; held-back pixels give no color.

    The color c behind the scene solves target = exposure (C + (1 - A) c) over the pixels of a cell by least squares.
    """
    view, effects = key_views.at(slot), Effects(outputs=("color", "alpha", "depth"))
    out = render(gaussians, view.camera(), effects=effects, max_pairs=max_pairs)
    learned = jnp.where(held_back_pixels(out.alpha.shape, slot, config), 0.0, 1.0)
    light = (1.0 - out.alpha) * learned
    lacking = light[..., None] * (view.images.astype(jnp.float32) / 255 / view.exposures - out.color)
    squares, weight, covered = _pooled(light * light), _pooled(learned), _pooled(out.alpha)
    share = jnp.where(weight > 0, _pooled(light) / jnp.maximum(weight, 1.0), 0.0)
    depths = jnp.where(covered > 0.5 * CELL * CELL, _pooled(out.alpha * out.depth) / jnp.maximum(covered, 1e-6), 0.0)
    filled = depths
    for reach in REACHES:  # empty cells get the mean around them, weighted by depth
        window = (2 * reach + 1, 2 * reach + 1)
        total, doubled = (
            jax.lax.reduce_window(x, 0.0, jax.lax.add, window, (1, 1), "SAME") for x in (depths, depths * depths)
        )
        filled = jnp.where(filled > 0, filled, doubled / jnp.maximum(total, 1e-12))
    return Cells(
        light=jnp.where(out.num_overflow > 0, 0.0, share),
        colors=jnp.clip(_pooled(lacking) / jnp.maximum(squares, 1e-6)[..., None], 0.0, 1.0 / view.exposures),
        depths=filled,
    )


def gaussians_of_cells(cells: Cells, camera: Camera) -> Gaussians:
    """A Gaussian for every cell of one view, in row-major order: it faces the camera and covers the cell."""
    height, width = cells.light.shape
    pixels, depths = pixel_grid(height * CELL, width * CELL, CELL).reshape(-1, 2), cells.depths.reshape(-1)
    to_world = invert_poses(camera.viewmats)
    across = 0.5 * CELL * depths / ((jnp.abs(camera.Ks[0, 0]) + jnp.abs(camera.Ks[1, 1])) / 2)
    return Gaussians.from_rgb(
        means=transform_points(to_world, unproject(pixels, depths, camera.Ks)),
        quats=jnp.broadcast_to(matrices_to_quats(to_world[:3, :3]), (len(depths), 4)),
        scales=across[:, None] * jnp.array([1.0, 1.0, THICKNESS]),
        opacities=jnp.full(depths.shape, OPACITY),
        colors=cells.colors.reshape(-1, 3),
    )


def hides(points: Float[Array, "n 3"], cells: Cells, key_views: KeyViews) -> Bool[Array, " n"]:
    """Mask of the points that hide a surface in more than `MAX_HIDING` of the valid views that see their place."""

    def in_view(slot: Int[Array, ""]) -> tuple[Array, Array]:
        inside, rows, columns, z = _cells_of_points(points, key_views.camera(slot), cells.light.shape[1:])
        inside &= key_views.valid[slot]
        depth, light = cells.depths[slot, rows, columns], cells.light[slot, rows, columns]
        return inside, inside & (light < MIN_LIGHT) & (z < IN_FRONT * depth)

    inside, is_before = (
        x.sum(axis=0, dtype=jnp.float32) for x in jax.lax.map(in_view, jnp.arange(key_views.num_slots))
    )
    return is_before > MAX_HIDING * inside


def _cells_of_points(points: Float[Array, "n 3"], camera: Camera, shape: tuple[int, ...]):
    """Mask of the points in the image of a camera, their rows and columns of cells, and their camera z."""
    pixels, z = project_points(transform_points(camera.viewmats, points), camera.Ks)
    places = jnp.floor(jnp.nan_to_num(pixels, nan=-1.0) / CELL)
    limits = jnp.array([shape[1], shape[0]], places.dtype)
    inside = (z > 0) & jnp.all((places >= 0) & (places < limits), axis=-1)
    columns, rows = jnp.moveaxis(jnp.clip(places, 0.0, limits - 1.0).astype(jnp.int32), -1, 0)
    return inside, rows, columns, z


def _pooled(values: Float[Array, "h w *c"]) -> Float[Array, "hc wc *c"]:
    """Sums over cells; pixels beyond the last whole cell are left out."""
    height, width = (length // CELL for length in values.shape[:2])
    values = values[: height * CELL, : width * CELL]
    return values.reshape(height, CELL, width, CELL, *values.shape[2:]).sum(axis=(1, 3))
