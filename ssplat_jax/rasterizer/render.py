"""`render`: differentiable images of Gaussians, by the tiled fast path."""

import functools
import warnings

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int, Num

from ssplat_jax.core.cameras import Camera, check_camera, is_whole, relative_to
from ssplat_jax.core.errors import InputError, echo, refusal
from ssplat_jax.core.gaussians import Gaussians, check_gaussians
from ssplat_jax.core.kept_programs import Kept
from ssplat_jax.core.numerics import power_of_two, with_rank_promotion
from ssplat_jax.core.pytree import pytree, replace
from ssplat_jax.rasterizer.binning import Grid, count_intersections, intersect_tiles, sorted_table
from ssplat_jax.rasterizer.compositing import composite, median_rows
from ssplat_jax.rasterizer.effects import NEEDED_ARRAYS, Effects, filter_3d
from ssplat_jax.rasterizer.outputs import RenderOutput, finish, splat_channels
from ssplat_jax.rasterizer.pinhole_projection import project_pinhole
from ssplat_jax.rasterizer.projection import cull_cameras, cull_non_finite, project

TILE = 8  # default side of a tile, pixels
TILES = (4, 8, 16)  # the sides of tiles that are tested and measured
MIN_CAPACITY = 1 << 12  # least capacity for pairs that `render` chooses

SMALL_CAPACITY = 1 << 18
"""Up to this capacity a render outside jit has room for a pair of each Gaussian and camera. Unused ones cost it a
twentieth of its time at most; a program that counts the pairs, or one for fewer, takes seconds to compile."""

MAX_CAPACITY = 1 << 30  # the largest power of two that an index reaches


@pytree
class RenderInputs:
    """The arrays of one call of `render`, which describes them."""

    gaussians: Gaussians
    camera: Camera
    features: Float[Array, "n c"] | None = None
    captured: Camera | None = None
    distortion: Float[Array, "*b 5"] | None = None
    exposures: Float[Array, "*b 3 4"] | None = None
    near: Float[Array, ""] | None = None


@with_rank_promotion
def render(
    gaussians: Gaussians,
    camera: Camera,
    *,
    effects: Effects | None = None,
    features: Float[Array, "n c"] | None = None,
    captured: Camera | None = None,
    distortion: Float[Array, "*b 5"] | None = None,
    exposures: Float[Array, "*b 3 4"] | None = None,
    near: float | None = None,
    max_pairs: int | None = None,
    tile: int = TILE,
) -> RenderOutput:
    """Images of Gaussians, differentiable in every array.

    Second derivatives are taken forward over reverse: `jax.jvp(jax.grad(loss), ...)`, `jax.hessian`. JAX refuses
    `jax.grad` of `jax.grad`, and `jax.jvp` alone.

    An array that is given switches its effect on, unless its flag in `effects` is False; an array that is None adds no
    operation to the program.

    Args:
        gaussians: the scene, in the world frame of the camera; rows of opacity 0 are absent.
        camera: poses (world to camera, OpenCV axes), intrinsics and the image size, of one camera or a batch; a
            negative focal length mirrors the image.
        effects: filter, background and outputs; `effects_for` finds what a scene needs.
        features: further channels, composited like colors.
        captured: the cameras that the scene was made from, for the 3D smoothing filter.
        distortion: OPENCV coefficients k1, k2, p1, p2, k3 of the lens.
        exposures: affine color correction of each frame, RGB' = matrix @ RGB + offset.
        near: Gaussians at a camera z of at most this are culled, scene units; by default 0.01, or what fits the unit of
            the scene (`near_planes`).
        max_pairs: capacity for tile intersections, (tile, Gaussian) pairs of all cameras. Outside jit, under `jax.grad`
            too, it is by default what all of them need, as a power of two so that few programs are compiled; those of a
            large scene are counted in its first render. Inside jit and other transforms that hide the values it is four
            for each Gaussian and camera, and a warning says if that was too few. The farthest Gaussians are left out;
            `num_overflow` counts the pairs.
        tile: side of a tile in pixels, 4, 8 or 16; choose 16 where most Gaussians are larger than 8 pixels, and 4 for
            gradients of scenes whose Gaussians are smaller than a pixel.

    Returns:
        Images with the camera's batch axes, and counts of what was left out.

    Raises:
        InputError: an array does not have the shape above, a flag of `effects` is True without its array, `max_pairs`
            is below 1, `tile` is none of these, or (outside jit) there are more than 2^30 pairs.
    """
    inputs = RenderInputs(gaussians, camera, features, captured, distortion, exposures)
    _check(inputs)
    arrays = {"captured": captured, "distortion": distortion, "exposures": exposures}
    effects = (effects or Effects()).resolve(gaussians.render_mode, **arrays)
    inputs = _at_the_origin(inputs)
    if near is not None:
        inputs = replace(inputs, near=jnp.asarray(near, jnp.float32))
    if effects.sh_degree is not None and effects.sh_degree >= gaussians.sh_degree:
        effects = effects.replace(sh_degree=None)  # the same program
    off = {name: None for field, name in NEEDED_ARRAYS.items() if not getattr(effects, field)}
    inputs = _at_least_one_row(replace(inputs, **off))
    if max_pairs is not None and not (is_whole(max_pairs) and max_pairs >= 1):
        raise InputError(f"render: max_pairs must be a whole number of at least 1, got {echo(max_pairs)}.")
    if not (is_whole(tile) and tile in TILES):
        raise InputError(f"render: tile must be 4, 8 or 16 pixels, got {echo(tile)}.")
    # NumPy's integers, as of an image's shape, count as whole numbers, but have no `bit_length`.
    tile, max_pairs = int(tile), None if max_pairs is None else int(max_pairs)
    camera = replace(inputs.camera, width=int(camera.width), height=int(camera.height))
    inputs = replace(inputs, camera=camera)
    # Inside jit every result is traced, even that of arrays which the function closes over.
    arrays = (*jax.tree.leaves(inputs), jax.device_put(np.float32(0)))  # jnp.zeros would compile a program
    is_concrete = max_pairs is None and not any(isinstance(x, Tracer) for x in arrays)
    # Views of one scene need about the same capacity: a pass that only counts costs a third of a render.
    num_rows = inputs.gaussians.num_gaussians * (camera.viewmats.size // 16)
    known = (num_rows, camera.viewmats.shape, camera.width, camera.height, tile)
    if is_concrete:
        max_pairs = _CAPACITIES.get(known)  # at once: another thread may forget it
        if max_pairs is None and num_rows <= SMALL_CAPACITY:
            max_pairs = capacity_for(0, num_rows)
    is_guessed = False
    if max_pairs is None:
        # Under `jax.grad` alone the primal values are concrete: without tangents, the pairs can be counted.
        counted = _count(jax.lax.stop_gradient(inputs), effects, tile)
        is_guessed = isinstance(counted, Tracer)
        max_pairs = min(round_up(4 * num_rows), MAX_CAPACITY) if is_guessed else capacity_for(int(counted), num_rows)
    out = _render_jit(inputs, effects, max_pairs, tile)
    if not isinstance(out.num_overflow, Tracer) and int(out.num_overflow):
        out = _render_jit(inputs, effects, capacity_for(int(out.num_pairs), num_rows), tile)
    elif is_guessed:
        say = lambda: jax.debug.callback(_warn_of_overflow, out.num_overflow, out.num_pairs)  # noqa: E731
        jax.lax.cond(out.num_overflow > 0, say, lambda: None)
    if is_concrete:
        _remember_capacity(known, int(out.num_pairs))
    return out


def count_pairs(gaussians: Gaussians, camera: Camera, effects: Effects, tile: int = TILE) -> Int[Array, ""]:
    """`RenderOutput.num_pairs` of a render without further arrays, at a third of its cost."""
    effects = effects.resolve(gaussians.render_mode, captured=None, distortion=None, exposures=None)
    inputs = _at_least_one_row(_at_the_origin(RenderInputs(gaussians, camera)))
    return _count(inputs, effects, tile)


_CAPACITIES: dict[tuple, int] = {}
"""Capacity of the last render outside jit, by number of Gaussians, cameras, image size and tile."""

MAX_REMEMBERED = 256
"""Kinds of renders that are remembered; a scene that grows with every chunk is a new kind each time."""


def _remember_capacity(kind: tuple, num_pairs: int) -> None:
    """Remembers the capacity for `num_pairs`; a larger one is kept if it is small or at most four times as large."""
    needed, held = capacity_for(num_pairs, kind[0]), _CAPACITIES.pop(kind, 0)
    _CAPACITIES[kind] = held if needed <= held <= max(4 * needed, SMALL_CAPACITY) else needed
    while len(_CAPACITIES) > MAX_REMEMBERED:
        _CAPACITIES.pop(next(iter(_CAPACITIES.copy())), None)


def _warn_of_overflow(num_overflow, num_pairs) -> None:
    """Warns of an image that lacks pairs; `vmap` and gradients call it for images that lack none too."""
    if (lacking := int(np.max(num_overflow))) > 0:
        warnings.warn(
            f"render: {lacking} (tile, Gaussian) pairs were left out, since inside jit their number is not known; pass"
            f" max_pairs={round_up(int(np.max(num_pairs)))}.",
            stacklevel=2,
        )


def capacity_for(num_pairs: int, num_rows: int) -> int:
    """The capacity for a number of pairs, of a scene with so many rows for all cameras.

    Raises:
        InputError: an index would not reach the last pair.
    """
    if num_pairs > MAX_CAPACITY:
        wanted = f"at most {MAX_CAPACITY} (tile, Gaussian) pairs"
        raise refusal("render", wanted=wanted, got="more", fix="render fewer cameras at once or pass tile=16")
    return max(round_up(num_pairs), min(power_of_two(num_rows), SMALL_CAPACITY))


def _at_the_origin(inputs: RenderInputs) -> RenderInputs:
    """`inputs` with cameras relative to the offset of the scene, which then has none: its program serves all scenes."""
    gaussians, offset = inputs.gaussians, inputs.gaussians.offset
    captured = None if inputs.captured is None else relative_to(inputs.captured, offset)
    plain = replace(gaussians, render_mode="mip", offset=(0.0, 0.0, 0.0))
    return replace(inputs, gaussians=plain, camera=relative_to(inputs.camera, offset), captured=captured)


def _at_least_one_row(inputs: RenderInputs) -> RenderInputs:
    """`inputs`, with one absent Gaussian if the scene is empty: arrays without rows cannot be indexed."""
    if inputs.gaussians.num_gaussians:
        return inputs
    one = jax.tree.map(lambda x: jnp.zeros((1, *x.shape[1:]), x.dtype), (inputs.gaussians, inputs.features))
    return replace(inputs, gaussians=one[0], features=one[1])


def round_up(num_pairs: int) -> int:
    """The next power of two, at least `MIN_CAPACITY`."""
    return max(MIN_CAPACITY, power_of_two(num_pairs))


def _check(inputs: RenderInputs) -> None:
    """Refuses arrays of the wrong shape, and what is not an array."""
    camera, features = inputs.camera, inputs.features
    for name, held in (("gaussians", Gaussians), ("camera", Camera), ("captured", Camera)):
        given = getattr(inputs, name)
        if not isinstance(given, held) and not (name == "captured" and given is None):
            raise InputError(f"render: {name} must be {held.__name__}, got {type(given).__name__}.")
    check_gaussians(inputs.gaussians, "render")
    for name in ("features", "distortion", "exposures"):
        if not hasattr(array := getattr(inputs, name), "shape") and array is not None:
            raise InputError(f"render: {name} must be an array, got {echo(array)}; wrap it in jnp.asarray.")
    check_camera(camera, "render")
    if inputs.captured is not None:
        check_camera(inputs.captured, "render", "captured camera")
    batch, rows = camera.viewmats.shape[:-2], inputs.gaussians.num_gaussians
    if 0 in batch:
        raise InputError(f"render: wanted at least one camera, got a batch of shape {list(batch)}.")
    if inputs.gaussians.sh.shape[1] not in (1, 4, 9, 16):
        raise InputError(f"render: sh must hold 1, 4, 9 or 16 terms a Gaussian, got {inputs.gaussians.sh.shape[1]}.")
    if features is not None and (features.ndim != 2 or features.shape[0] != rows):
        raise InputError(f"render: features must be [{rows} c], got {list(features.shape)}.")
    for name, array, tail in (("distortion", inputs.distortion, (5,)), ("exposures", inputs.exposures, (3, 4))):
        if array is not None and array.shape != (*batch, *tail):
            raise InputError(f"render: {name} must be {[*batch, *tail]}, got {list(array.shape)}.")


def prepare(inputs: RenderInputs, effects: Effects):
    """The projection stage: finite Gaussians in float32 (float64 if given), the camera with one batch axis, the splats,
    and the number of rows culled. The effects are resolved, see `Effects.resolve`.
    """
    given = inputs.gaussians.means.dtype
    dtype = given if given == jnp.float64 else jnp.dtype(jnp.float32)
    gaussians = jax.tree.map(lambda x: x.astype(dtype), inputs.gaussians)
    if effects.sh_degree is not None:
        gaussians = replace(gaussians, sh=gaussians.sh[:, : (effects.sh_degree + 1) ** 2])
    gaussians, num_non_finite = cull_non_finite(gaussians, inputs.features)
    if inputs.captured is not None:
        gaussians = filter_3d(gaussians, inputs.captured)
    viewmats, Ks = inputs.camera.viewmats.reshape(-1, 4, 4), inputs.camera.Ks.reshape(-1, 3, 3)
    camera, usable = cull_cameras(replace(inputs.camera, viewmats=viewmats.astype(dtype), Ks=Ks.astype(dtype)))
    distortion = None if inputs.distortion is None else inputs.distortion.reshape(-1, 5).astype(dtype)
    near = None if inputs.near is None else jnp.broadcast_to(inputs.near.astype(dtype), camera.viewmats.shape[:1])
    if distortion is not None:
        splats = project(gaussians, camera, effects, distortion, near)
    else:
        splats = project_pinhole(gaussians, camera, effects, near)
    visible = splats.visible & usable[:, None]
    splats = replace(splats, visible=visible, opacities=jnp.where(visible, splats.opacities, 0.0))
    num_unseen = jnp.sum(~usable, dtype=jnp.int32) * gaussians.num_gaussians
    return gaussians, camera, splats, num_non_finite + num_unseen


def tile_grid_of(camera: Camera, tile: int) -> Grid:
    """The tiles of all images of a camera with one batch axis."""
    return Grid(num_images=camera.viewmats.shape[0], height=camera.height, width=camera.width, tile=tile)


@functools.partial(Kept, static_argnums=(1, 2))
def _count(inputs: RenderInputs, effects: Effects, tile: int):
    _, camera, splats, _ = prepare(inputs, effects)
    return count_intersections(splats, tile_grid_of(camera, tile))


def _render(inputs: RenderInputs, effects: Effects, max_pairs: int, tile: int) -> RenderOutput:
    with jax.named_scope("project"):
        gaussians, camera, splats, num_non_finite = prepare(inputs, effects)
        channels = splat_channels(gaussians, splats, camera, effects, inputs.features)
    grid = tile_grid_of(camera, tile)
    with jax.named_scope("sort"):
        table, order = sorted_table(splats, channels, grid)
    with jax.named_scope("bin"):
        images = order // gaussians.num_gaussians
        pairs = intersect_tiles(jax.lax.stop_gradient(table), images, grid, max_pairs)
    median_depth = None
    with jax.named_scope("composite"):
        tiles = composite(grid, effects.needs_alpha, table, pairs)
        if "median_depth" in effects.outputs:
            rows = _untile(median_rows(grid, jax.lax.stop_gradient(table), pairs)[:, None], grid)[..., 0]
            depths = splats.depths.reshape(-1)[order[jnp.maximum(rows, 0)]]
            median_depth = jnp.where(rows >= 0, depths, 0.0)
    return finish(
        _untile(tiles, grid),  # pyright: ignore[reportArgumentType] - custom_vjp hides the type
        inputs.camera,
        effects,
        exposures=inputs.exposures,
        median_depth=median_depth,
        num_pairs=pairs.num_pairs,
        num_overflow=jnp.maximum(pairs.num_pairs - max_pairs, 0),
        num_non_finite=num_non_finite,
    )


_render_jit = Kept(_render, static_argnums=(1, 2, 3))


def render_program(gaussians: Gaussians, camera: Camera, max_pairs: int) -> jax.stages.Compiled:
    """The program that `render` runs for arrays of these shapes without effects, compiled so that it can be analyzed.

    Args:
        gaussians: the scene, or `jax.ShapeDtypeStruct` in place of its arrays.
        camera: the cameras, likewise.
        max_pairs: capacity for tile intersections.
    """
    effects = Effects().resolve("mip", captured=None, distortion=None, exposures=None)
    return _render_jit.program(RenderInputs(gaussians, camera), effects, round_up(max_pairs), TILE)


def _untile(tiles: Num[Array, "tiles c p"], grid: Grid) -> Num[Array, "b h w c"]:
    """Images from their tiles, cropped to the image size."""
    side, channels = grid.tile, tiles.shape[1]
    images = tiles.reshape(grid.num_images, grid.rows, grid.columns, channels, side, side).transpose(0, 1, 4, 2, 5, 3)
    images = images.reshape(grid.num_images, grid.rows * side, grid.columns * side, channels)
    return images[:, : grid.height, : grid.width]
