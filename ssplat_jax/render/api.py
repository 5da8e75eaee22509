"""`render`: Gaussians and cameras to images, differentiably, through the tiled fast path."""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ssplat_jax.errors import InputError
from ssplat_jax.gaussians import Gaussians
from ssplat_jax.geometry.cameras import Camera
from ssplat_jax.render.binning import Grid, bin_splats, count_pairs
from ssplat_jax.render.effects import Effects
from ssplat_jax.render.output import RenderOutput, finish, splat_channels
from ssplat_jax.render.projection import Splats, cull_non_finite, project
from ssplat_jax.render.tiled import composite
from ssplat_jax.struct import replace

TILE = 8
MIN_PAIRS = 1 << 12


def render(
    gaussians: Gaussians,
    camera: Camera,
    *,
    effects: Effects | None = None,
    features: Float[Array, "n c"] | None = None,
    max_pairs: int | None = None,
    tile: int = TILE,
) -> RenderOutput:
    """Images of `gaussians` from `camera` (one, or a batch with leading axes), differentiable in every array.

    Args:
        gaussians: the scene; rows of opacity 0 are absent.
        camera: poses, intrinsics and the image size (any, not only multiples of a tile).
        effects: what to simulate and which outputs to give.
        features: further channels, composited like colours.
        max_pairs: room for (tile, Gaussian) pairs, of all cameras together. Outside jit it is counted (and rounded up
            to a power of two, so that few programs are compiled). Inside jit the default is four pairs a Gaussian and
            camera; look at `num_overflow` there: what does not fit is the farthest Gaussians.
        tile: side of a tile in pixels, 8 or 16: 16 where most Gaussians are larger than 8 pixels.

    Raises:
        InputError: the camera or the features do not have the shapes above.
    """
    effects = effects or Effects()
    _check(gaussians, camera, features)
    traced = any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((gaussians, camera, features)))
    if traced:
        return _render(gaussians, camera, features, effects, max_pairs or default_max_pairs(gaussians, camera), tile)
    if max_pairs is None:
        max_pairs = round_up(int(_count(gaussians, camera, effects, tile)))
    out = _render_jit(gaussians, camera, features, effects, max_pairs, tile)
    if int(out.num_overflow):
        out = _render_jit(gaussians, camera, features, effects, round_up(int(out.num_pairs)), tile)
    return out


def default_max_pairs(gaussians: Gaussians, camera: Camera) -> int:
    """The capacity inside jit when none is passed: four pairs a row and camera, as a power of two."""
    cameras = camera.viewmats.size // 16
    return round_up(4 * cameras * gaussians.num_gaussians)


def round_up(num_pairs: int) -> int:
    """The next power of two, at least `MIN_PAIRS`."""
    return max(MIN_PAIRS, 1 << (num_pairs - 1).bit_length()) if num_pairs > 0 else MIN_PAIRS


def _check(gaussians: Gaussians, camera: Camera, features) -> None:
    if camera.viewmats.shape[-2:] != (4, 4) or camera.Ks.shape != (*camera.viewmats.shape[:-2], 3, 3):
        raise InputError(
            f"render: camera wants viewmats [*b 4 4] and Ks [*b 3 3], got {camera.viewmats.shape} and {camera.Ks.shape}."
        )
    if camera.width < 1 or camera.height < 1:
        raise InputError(f"render: the image must have at least 1x1 pixels, got {camera.width}x{camera.height}.")
    if features is not None and (features.ndim != 2 or features.shape[0] != gaussians.num_gaussians):
        raise InputError(f"render: features must be [{gaussians.num_gaussians} c], got {list(features.shape)}.")


def prepare(gaussians: Gaussians, camera: Camera):
    """Finite float32 (or wider) Gaussians, a camera of one batch axis, and the number of rows culled."""
    dtype = jnp.promote_types(gaussians.means.dtype, jnp.float32)
    gaussians, num_non_finite = cull_non_finite(jax.tree.map(lambda x: x.astype(dtype), gaussians))
    camera = replace(
        camera, viewmats=camera.viewmats.reshape(-1, 4, 4).astype(dtype), Ks=camera.Ks.reshape(-1, 3, 3).astype(dtype)
    )
    return gaussians, camera, num_non_finite


def grid_of(camera: Camera, tile: int) -> Grid:
    """The tiles of all images of a camera with one batch axis."""
    return Grid(num_images=camera.viewmats.shape[0], height=camera.height, width=camera.width, tile=tile)


@functools.partial(jax.jit, static_argnums=(2, 3))
def _count(gaussians: Gaussians, camera: Camera, effects: Effects, tile: int):
    gaussians, camera, _ = prepare(gaussians, camera)
    return count_pairs(project(gaussians, camera, effects), grid_of(camera, tile))


def _render(gaussians: Gaussians, camera: Camera, features, effects: Effects, max_pairs: int, tile: int):
    shape_of_batch = camera
    with jax.named_scope("project"):
        gaussians, camera, num_non_finite = prepare(gaussians, camera)
        splats = project(gaussians, camera, effects)
        channels = splat_channels(gaussians, splats, camera, effects, features)
    grid = grid_of(camera, tile)
    with jax.named_scope("bin"):
        pairs = bin_splats(jax.lax.stop_gradient(splats), grid, max_pairs)
    with jax.named_scope("composite"):
        tiles = composite(grid, shape_rows(splats), channels.reshape(-1, channels.shape[-1]), pairs)
    return finish(
        untile(tiles, grid),
        shape_of_batch,
        effects,
        num_pairs=pairs.num_pairs,
        num_overflow=jnp.maximum(pairs.num_pairs - max_pairs, 0),
        num_non_finite=num_non_finite,
    )


_render_jit = functools.partial(jax.jit, static_argnums=(3, 4, 5))(_render)


def shape_rows(splats: Splats) -> Float[Array, "m 6"]:
    """What compositing needs of each (camera, Gaussian): x, y, conic xx, xy, yy, opacity."""
    return jnp.concatenate([splats.means2d, splats.conics, splats.opacities[..., None]], axis=-1).reshape(-1, 6)


def untile(tiles: Float[Array, "tiles c p"], grid: Grid) -> Float[Array, "b h w c"]:
    """Tiles put together to images and cropped to their size."""
    side, channels = grid.tile, tiles.shape[1]
    images = tiles.reshape(grid.num_images, grid.rows, grid.columns, channels, side, side).transpose(0, 1, 4, 2, 5, 3)
    images = images.reshape(grid.num_images, grid.rows * side, grid.columns * side, channels)
    return images[:, : grid.height, : grid.width]
