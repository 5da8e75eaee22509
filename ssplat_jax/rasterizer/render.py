"""`render`: Gaussians and cameras to images, differentiably, through the tiled fast path."""

import functools

import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Float, Num

from ssplat_jax.errors import InputError
from ssplat_jax.gaussians import Gaussians
from ssplat_jax.geometry.cameras import Camera
from ssplat_jax.pytree import pytree, replace
from ssplat_jax.rasterizer.binning import bin_rows, count_pairs
from ssplat_jax.rasterizer.compositing import composite, median_rows
from ssplat_jax.rasterizer.depth_sorted_table import sorted_table
from ssplat_jax.rasterizer.effects import Effects
from ssplat_jax.rasterizer.filter_3d import filter_3d
from ssplat_jax.rasterizer.outputs import RenderOutput, finish, splat_channels
from ssplat_jax.rasterizer.projection import cull_cameras, cull_non_finite, project
from ssplat_jax.rasterizer.tile_grid import Grid

TILE = 8
MIN_PAIRS = 1 << 12
MOST_ROOM = 1 << 30  # the last power of two that an index reaches


@pytree
class Inputs:
    """The arrays of one call of `render`; what each is stands there."""

    gaussians: Gaussians
    camera: Camera
    features: Float[Array, "n c"] | None = None
    captured: Camera | None = None
    distortion: Float[Array, "*b 5"] | None = None
    exposures: Float[Array, "*b 3 4"] | None = None


def render(
    gaussians: Gaussians,
    camera: Camera,
    *,
    effects: Effects | None = None,
    features: Float[Array, "n c"] | None = None,
    captured: Camera | None = None,
    distortion: Float[Array, "*b 5"] | None = None,
    exposures: Float[Array, "*b 3 4"] | None = None,
    max_pairs: int | None = None,
    tile: int = TILE,
) -> RenderOutput:
    """Images of `gaussians` from `camera` (one, or a batch with leading axes), differentiable in every array.

    Args:
        gaussians: the scene; rows of opacity 0 are absent.
        camera: poses, intrinsics and the image size (any, not only multiples of a tile).
        effects: what to simulate and which outputs to give; `effects_for` finds what a scene needs.
        features: further channels, composited like colors.
        captured: for `effects.filter_3d`, the cameras that the scene was made from.
        distortion: for `effects.distortion`, OPENCV coefficients k1, k2, p1, p2, k3.
        exposures: for `effects.exposure`, an affine color correction a frame.
        max_pairs: room for (tile, Gaussian) pairs, of all cameras together. Outside jit it is counted (and rounded up
            to a power of two, so that few programs are compiled), under `jax.grad` too. Inside jit the default is four
            pairs a Gaussian and camera; look at `num_overflow` there: what does not fit is the farthest Gaussians.
        tile: side of a tile in pixels, 8 or 16: 16 where most Gaussians are larger than 8 pixels.

    Raises:
        InputError: an array does not have the shape above, an effect lacks its array, `max_pairs` or `tile` is no
            positive number, or (outside jit) there are more pairs than 2^31.
    """
    effects = effects or Effects()
    inputs = Inputs(gaussians, camera, features, captured, distortion, exposures)
    _check(inputs, effects)
    inputs = _at_least_one_row(inputs)
    for name, number in (("max_pairs", max_pairs), ("tile", tile)):
        if number is not None and number < 1:
            raise InputError(f"render: {name} must be at least 1, got {number}.")
    if max_pairs is None:
        # Differentiation alone leaves the numbers there: without its tangents, what it traces can be counted.
        counted = _count(jax.lax.stop_gradient(inputs), effects, tile)
        is_traced = isinstance(counted, Tracer)
        max_pairs = default_max_pairs(inputs.gaussians, camera) if is_traced else _room_for(int(counted))
    out = _render_jit(inputs, effects, max_pairs, tile)
    if not isinstance(out.num_overflow, Tracer) and int(out.num_overflow):
        out = _render_jit(inputs, effects, _room_for(int(out.num_pairs)), tile)
    return out


def _room_for(num_pairs: int) -> int:
    """`round_up`, for a number whose power of two an index can reach."""
    if num_pairs > MOST_ROOM:
        raise InputError(
            f"render: wanted at most {MOST_ROOM} pairs of a tile and a Gaussian, got more; render fewer cameras at"
            " once or with tile=16."
        )
    return round_up(num_pairs)


def _at_least_one_row(inputs: Inputs) -> Inputs:
    """A scene of no Gaussians gets an absent one: arrays of no rows have nothing to index."""
    if inputs.gaussians.num_gaussians:
        return inputs
    one = jax.tree.map(lambda x: jnp.zeros((1, *x.shape[1:]), x.dtype), (inputs.gaussians, inputs.features))
    return replace(inputs, gaussians=one[0], features=one[1])


def default_max_pairs(gaussians: Gaussians, camera: Camera) -> int:
    """The capacity inside jit when none is passed: four pairs a row and camera, as a power of two."""
    cameras = camera.viewmats.size // 16
    return min(round_up(4 * cameras * gaussians.num_gaussians), MOST_ROOM)


def round_up(num_pairs: int) -> int:
    """The next power of two, at least `MIN_PAIRS`."""
    return max(MIN_PAIRS, 1 << (num_pairs - 1).bit_length()) if num_pairs > 0 else MIN_PAIRS


def _check(inputs: Inputs, effects: Effects) -> None:
    camera, features = inputs.camera, inputs.features
    batch, rows = camera.viewmats.shape[:-2], inputs.gaussians.num_gaussians
    if camera.viewmats.shape[-2:] != (4, 4) or camera.Ks.shape != (*batch, 3, 3):
        raise InputError(
            "render: camera wants viewmats [*b 4 4] and Ks [*b 3 3], "
            f"got {list(camera.viewmats.shape)} and {list(camera.Ks.shape)}."
        )
    if 0 in batch:
        raise InputError(f"render: wanted at least one camera, got a batch of shape {list(batch)}.")
    if inputs.gaussians.sh.shape[1] not in (1, 4, 9, 16):
        raise InputError(f"render: sh must hold 1, 4, 9 or 16 terms a Gaussian, got {inputs.gaussians.sh.shape[1]}.")
    if camera.width < 1 or camera.height < 1:
        raise InputError(f"render: the image must have at least 1x1 pixels, got {camera.width}x{camera.height}.")
    if features is not None and (features.ndim != 2 or features.shape[0] != rows):
        raise InputError(f"render: features must be [{rows} c], got {list(features.shape)}.")
    if effects.filter_3d and inputs.captured is None:
        raise InputError("render: effects.filter_3d needs the captured cameras; pass captured=... or turn it off.")
    for on, name, array, tail in (
        (effects.distortion, "distortion", inputs.distortion, (5,)),
        (effects.exposure, "exposures", inputs.exposures, (3, 4)),
    ):
        if on and (array is None or array.shape != (*batch, *tail)):
            came = "nothing" if array is None else list(array.shape)
            raise InputError(f"render: {name} must be {[*batch, *tail]} while its effect is on, got {came}.")


def prepare(inputs: Inputs, effects: Effects):
    """Finite float32 (or wider) Gaussians, a camera of one batch axis, their splats, and the number of rows culled."""
    given = inputs.gaussians.means.dtype
    dtype = given if given == jnp.float64 else jnp.dtype(jnp.float32)
    gaussians = jax.tree.map(lambda x: x.astype(dtype), inputs.gaussians)
    if effects.sh_degree is not None:
        gaussians = replace(gaussians, sh=gaussians.sh[:, : (effects.sh_degree + 1) ** 2])
    gaussians, num_non_finite = cull_non_finite(gaussians, inputs.features)
    if effects.filter_3d and inputs.captured is not None:
        gaussians = filter_3d(gaussians, inputs.captured)
    camera = inputs.camera
    camera = replace(
        camera, viewmats=camera.viewmats.reshape(-1, 4, 4).astype(dtype), Ks=camera.Ks.reshape(-1, 3, 3).astype(dtype)
    )
    distortion = inputs.distortion.reshape(-1, 5).astype(dtype) if effects.distortion else None  # pyright: ignore[reportOptionalMemberAccess]
    camera, usable = cull_cameras(camera)
    splats = project(gaussians, camera, effects, distortion)
    visible = splats.visible & usable[:, None]
    splats = replace(splats, visible=visible, opacities=jnp.where(visible, splats.opacities, 0.0))
    num_unseen = jnp.sum(~usable, dtype=jnp.int32) * gaussians.num_gaussians
    return gaussians, camera, splats, num_non_finite + num_unseen


def grid_of(camera: Camera, tile: int) -> Grid:
    """The tiles of all images of a camera with one batch axis."""
    return Grid(num_images=camera.viewmats.shape[0], height=camera.height, width=camera.width, tile=tile)


@functools.partial(jax.jit, static_argnums=(1, 2))
def _count(inputs: Inputs, effects: Effects, tile: int):
    _, camera, splats, _ = prepare(inputs, effects)
    return count_pairs(splats, grid_of(camera, tile))


def _render(inputs: Inputs, effects: Effects, max_pairs: int, tile: int) -> RenderOutput:
    with jax.named_scope("project"):
        gaussians, camera, splats, num_non_finite = prepare(inputs, effects)
        channels = splat_channels(gaussians, splats, camera, effects, inputs.features)
    grid = grid_of(camera, tile)
    with jax.named_scope("sort"):
        table, order = sorted_table(splats, channels, grid)
    with jax.named_scope("bin"):
        images = order // gaussians.num_gaussians
        pairs = bin_rows(jax.lax.stop_gradient(table), images, grid, max_pairs)
    median_depth = None
    with jax.named_scope("composite"):
        tiles = composite(grid, effects.needs_alpha, table, pairs)
        if "median_depth" in effects.outputs:
            rows = untile(median_rows(grid, jax.lax.stop_gradient(table), pairs)[:, None], grid)[..., 0]
            depths = splats.depths.reshape(-1)[order[jnp.maximum(rows, 0)]]
            median_depth = jnp.where(rows >= 0, depths, 0.0)
    return finish(
        untile(tiles, grid),  # pyright: ignore[reportArgumentType] - custom_vjp hides the type
        inputs.camera,
        effects,
        exposures=inputs.exposures,
        median_depth=median_depth,
        num_pairs=pairs.num_pairs,
        num_overflow=jnp.maximum(pairs.num_pairs - max_pairs, 0),
        num_non_finite=num_non_finite,
    )


_render_jit = functools.partial(jax.jit, static_argnums=(1, 2, 3))(_render)


def untile(tiles: Num[Array, "tiles c p"], grid: Grid) -> Num[Array, "b h w c"]:
    """Tiles put together to images and cropped to their size."""
    side, channels = grid.tile, tiles.shape[1]
    images = tiles.reshape(grid.num_images, grid.rows, grid.columns, channels, side, side).transpose(0, 1, 4, 2, 5, 3)
    images = images.reshape(grid.num_images, grid.rows * side, grid.columns * side, channels)
    return images[:, : grid.height, : grid.width]
