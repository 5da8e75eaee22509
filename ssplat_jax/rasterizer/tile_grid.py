"""The tiles of images, and the tiles that a box covers."""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ssplat_jax.core.numerics import columns
from ssplat_jax.core.pytree import pytree, static


@pytree
class Grid:
    """The tiles of `b` images of one size."""

    num_images: int = static()
    height: int = static()
    width: int = static()
    tile: int = static()

    @property
    def rows(self) -> int:
        """Tiles down an image."""
        return -(-self.height // self.tile)

    @property
    def columns(self) -> int:
        """Tiles across an image."""
        return -(-self.width // self.tile)

    @property
    def num_tiles(self) -> int:
        """Tiles of all images."""
        return self.num_images * self.rows * self.columns


def tile_boxes(means2d: Float[Array, "*m 2"], radii: Float[Array, "*m 2"], grid: Grid) -> tuple[Int[Array, "*m"], ...]:
    """Left, top, width and height, in tiles, of what each box covers; boxes of radius 0 cover none."""
    sides = []
    for mean, radius, limit in zip(columns(means2d), columns(radii), (grid.columns, grid.rows), strict=True):
        low, high = (jnp.floor((mean + sign * radius) / grid.tile) for sign in (-1, 1))
        low, high = jnp.clip(low, 0, limit), jnp.clip(high + 1, 0, limit)
        sides.append((low.astype(jnp.int32), jnp.where(radius > 0, high - low, 0).astype(jnp.int32)))
    (left, width), (top, height) = sides
    return left, top, width, height
