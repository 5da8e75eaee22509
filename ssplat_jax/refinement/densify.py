"""Densification: new Gaussians in the holes that key views show, at the depth of the surfaces around them.

each view ─► render ─► holes: cells that let light through, with a color, and the depth of what surrounds them
                           │
new Gaussians ◄─ holes that no new Gaussian fills yet, unless the new one would hide what other views show
"""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ssplat_jax.cache.key_views import KeyViews
from ssplat_jax.core.cameras import (
    Camera,
    invert_poses,
    pixel_grid,
    project_points,
    transform_points,
    unproject,
)
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.core.pytree import pytree
from ssplat_jax.core.rotations import matrices_to_quats
from ssplat_jax.rasterizer import Effects, render
from ssplat_jax.refinement.refine_config import RefineConfig
from ssplat_jax.refinement.view_loss import held_back_pixels

CELL = 4
"""Side of a cell of pixels, which one new Gaussian covers."""

LEAST_LIGHT = 0.5
"""Share of the light that must pass through a cell to make it a hole."""

REACHES = (2, 6)
"""Cells around a hole in which the depth of a surface is looked for; the farther ones where the near ones are empty."""

IN_FRONT = 0.9
"""A point nearer than this fraction of a view's depth hides what the view shows there."""

MOST_HIDING = 0.1
"""Largest share of the views that see a new Gaussian's place in which it may hide a surface: some depths are wrong."""

OPACITY = 0.7
"""Opacity of a new Gaussian."""

THICKNESS = 0.1
"""Standard deviation of a new Gaussian along the ray, as a fraction of that across."""


@pytree
class Cells:
    """The images of key views by cells of `CELL` x `CELL` pixels."""

    light: Float[Array, "*v hc wc"]  # share that passes through the scene
    colors: Float[Array, "*v hc wc 3"]  # color behind the scene that explains the image, in the scene's exposure
    depths: Float[Array, "*v hc wc"]  # camera z of what covers the cell, or of what surrounds it; 0 if unknown


def densify(
    gaussians: Gaussians, key_views: KeyViews, *, config: RefineConfig, max_pairs: int, max_new: int
) -> tuple[Gaussians, Int[Array, ""]]:
    """New Gaussians in the holes that key views show.

    A hole is a cell of which at least half of the light passes through the scene. Its Gaussian faces the camera, at the
    mean depth of the surroundings, weighted by depth: a gap mostly shows the surface behind.

    Args:
        gaussians: the scene.
        key_views: the views; those that are not valid show no hole.
        config: says which pixels are held back (static); their colors are not used.
        max_pairs: capacity for tile intersections (static). A view in which they do not fit shows no hole.
        max_new: capacity for new Gaussians (static); holes of later views stay where it is full.

    Returns:
        The new Gaussians `[max_new]`, and the number of those that are present: the first ones.
    """
    slots = jnp.arange(key_views.num_slots)
    cells = jax.lax.map(lambda view: cells_of_view(gaussians, key_views, view, config, max_pairs), slots)
    shape = cells.light.shape[1:]

    def add_view(so_far: tuple[Gaussians, Array], view: Int[Array, ""]):
        new, num_new = so_far
        own, camera = jax.tree.map(lambda x: x[view], cells), key_views.camera(view)
        candidates = gaussians_of_cells(own, camera, gaussians.sh.shape[1])
        is_new = key_views.valid[view] & (own.light >= LEAST_LIGHT) & (own.depths > 0)
        is_new &= ~_filled(new, camera, shape)
        is_new = is_new.reshape(-1) & ~hides(candidates.means, cells, key_views)
        for leaf in jax.tree.leaves(candidates):
            is_new &= jnp.all(jnp.isfinite(leaf.reshape(len(leaf), -1)), axis=1)
        places = jnp.where(is_new, num_new + jnp.cumsum(is_new, dtype=jnp.int32) - 1, max_new)
        new = jax.tree.map(lambda x, y: x.at[places].set(y, mode="drop"), new, candidates)
        return (new, jnp.minimum(num_new + jnp.sum(is_new, dtype=jnp.int32), max_new)), None

    none = jax.tree.map(lambda x: jnp.zeros((max_new, *x.shape[1:]), x.dtype), gaussians)
    return jax.lax.scan(add_view, (none, jnp.zeros((), jnp.int32)), slots)[0]


def cells_of_view(
    gaussians: Gaussians, key_views: KeyViews, view: Int[Array, ""], config: RefineConfig, max_pairs: int
) -> Cells:
    """Holes of a key view, their colors, and depths.

    The color c behind the scene solves target = exposure (C + (1 - A) c) over the pixels of a cell by least squares.
    """
    height, width = key_views.images.shape[1:3]
    effects = Effects(outputs=("color", "alpha", "depth"))
    out = render(gaussians, key_views.camera(view), effects=effects, max_pairs=max_pairs)
    learned = jnp.where(held_back_pixels((height, width), view, config), 0.0, 1.0)
    light = (1.0 - out.alpha) * learned
    exposure = key_views.exposures[view]
    target = key_views.images[view].astype(jnp.float32) / 255 / exposure
    lacking = light[..., None] * (target - out.color)
    squares, weight = _pooled(light * light), _pooled(learned)
    share = jnp.where(weight > 0, _pooled(light) / jnp.maximum(weight, 1.0), 0.0)
    covered = _pooled(out.alpha)
    depths = jnp.where(covered > 0.5 * CELL * CELL, _pooled(out.alpha * out.depth) / jnp.maximum(covered, 1e-6), 0.0)
    return Cells(
        light=jnp.where(out.num_overflow > 0, 0.0, share),
        colors=jnp.clip(_pooled(lacking) / jnp.maximum(squares, 1e-6)[..., None], 0.0, 1.0 / exposure),
        depths=_surrounding(depths),
    )


def gaussians_of_cells(cells: Cells, camera: Camera, num_bands: int) -> Gaussians:
    """A Gaussian for every cell of one view, in row-major order: it faces the camera and covers the cell."""
    height, width = cells.light.shape
    pixels = pixel_grid(height * CELL, width * CELL, CELL).reshape(-1, 2)
    depths = cells.depths.reshape(-1)
    to_world = invert_poses(camera.viewmats)
    focal = (jnp.abs(camera.Ks[0, 0]) + jnp.abs(camera.Ks[1, 1])) / 2
    across = 0.5 * CELL * depths / focal
    count = len(depths)
    flat = Gaussians.from_rgb(
        means=transform_points(to_world, unproject(pixels, depths, camera.Ks)),
        quats=jnp.broadcast_to(matrices_to_quats(to_world[:3, :3]), (count, 4)),
        scales=across[:, None] * jnp.array([1.0, 1.0, THICKNESS]),
        opacities=jnp.full((count,), OPACITY),
        colors=cells.colors.reshape(-1, 3),
    )
    bands = jnp.pad(flat.sh, ((0, 0), (0, num_bands - 1), (0, 0)))
    return Gaussians(means=flat.means, quats=flat.quats, scales=flat.scales, opacities=flat.opacities, sh=bands)


def hides(points: Float[Array, "n 3"], cells: Cells, key_views: KeyViews) -> Bool[Array, " n"]:
    """Mask of the points that hide a surface in more than `MOST_HIDING` of the views that see their place.

    Args:
        points: places in the scene.
        cells: depths and light of all views.
        key_views: their cameras; those that are not valid do not count.
    """
    height, width = cells.light.shape[1:]

    def in_view(view: Int[Array, ""]) -> tuple[Array, Array]:
        inside, rows, columns, z = _cells_of_points(points, key_views.camera(view), (height, width))
        inside &= key_views.valid[view]
        depth, light = cells.depths[view, rows, columns], cells.light[view, rows, columns]
        return inside, inside & (light < LEAST_LIGHT) & (z < IN_FRONT * depth)

    inside, is_before = jax.lax.map(in_view, jnp.arange(key_views.num_slots))
    count = lambda masks: jnp.sum(masks, axis=0, dtype=jnp.float32)  # noqa: E731
    return count(is_before) > MOST_HIDING * count(inside)


def _filled(new: Gaussians, camera: Camera, shape: tuple[int, int]) -> Bool[Array, "hc wc"]:
    """Mask of the cells of a view in which a new Gaussian lies, and of those beside them."""
    inside, rows, columns, _ = _cells_of_points(new.means, camera, shape)
    inside &= new.opacities > 0
    marks = jnp.zeros(shape, bool).at[jnp.where(inside, rows, shape[0]), columns].set(True, mode="drop")
    return jax.lax.reduce_window(marks, False, jax.lax.bitwise_or, (3, 3), (1, 1), "SAME")


def _cells_of_points(points: Float[Array, "n 3"], camera: Camera, shape: tuple[int, int]):
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


def _surrounding(depths: Float[Array, "hc wc"]) -> Float[Array, "hc wc"]:
    """Depths, in cells of depth 0 those around them: their mean weighted by depth, which favors far ones."""
    filled = depths
    for reach in REACHES:
        window = (2 * reach + 1, 2 * reach + 1)
        total, squares = (
            jax.lax.reduce_window(x, 0.0, jax.lax.add, window, (1, 1), "SAME") for x in (depths, depths * depths)
        )
        filled = jnp.where(filled > 0, filled, squares / jnp.maximum(total, 1e-12))
    return filled


@functools.cache
def compiled_densify(config: RefineConfig, max_pairs: int, max_new: int):
    """`densify`, jitted."""
    return jax.jit(functools.partial(densify, config=config, max_pairs=max_pairs, max_new=max_new))
