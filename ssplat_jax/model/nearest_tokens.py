"""Nearest neighbors of tokens in 3D, for the mixers (as in ReSplat)."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

SEARCH_BLOCK = 1024
"""Queries per block of the global search, which bounds the size of its distance matrix."""


def nearest_tokens(
    positions: Float[Array, "v hf wf 3"], inside: Bool[Array, "v hf wf"], num_neighbors: int, radius: int
) -> Int[Array, "m k"]:
    """Flat indices of each token's nearest tokens in 3D, the token itself first.

    Args:
        positions: token positions, stream frame.
        inside: tokens in the image. Others are chosen last.
        num_neighbors: neighbors per token, the token itself included; fewer where there are not so many candidates.
        radius: candidates are the (2 r + 1)^2 cells around a token in its own view; 0 for all tokens of all views.
    """
    if radius == 0:
        return _nearest_of_all(positions.reshape(-1, 3), inside.reshape(-1), num_neighbors)
    v, hf, wf, _ = positions.shape
    side = 2 * radius + 1
    flat = jnp.arange(v * hf * wf).reshape(v, hf, wf)
    rows = jnp.arange(hf)[:, None] + jnp.arange(side) - radius
    columns = jnp.arange(wf)[:, None] + jnp.arange(side) - radius
    in_rows, in_columns = (rows >= 0) & (rows < hf), (columns >= 0) & (columns < wf)
    in_grid = in_rows[:, None, :, None] & in_columns[None, :, None, :]
    in_grid = jnp.broadcast_to(in_grid, (v, *in_grid.shape)).reshape(v * hf * wf, side * side)
    rows, columns = jnp.clip(rows, 0, hf - 1), jnp.clip(columns, 0, wf - 1)
    candidates = flat[:, rows[:, None, :, None], columns[None, :, None, :]].reshape(v * hf * wf, side * side)
    points, usable = positions.reshape(-1, 3), inside.reshape(-1)
    offsets = points[candidates] - points[:, None]
    # At the border of the grid, clipped candidates repeat border cells: only cells inside the grid count.
    distances = jnp.where(usable[candidates] & in_grid, jnp.sum(offsets**2, axis=-1), jnp.inf)
    distances = distances.at[:, side * side // 2].set(-1.0)  # the token itself
    _, best = jax.lax.top_k(-distances, min(num_neighbors, side * side))
    return jnp.take_along_axis(candidates, best, axis=1)


def _nearest_of_all(points, usable, k):
    m = points.shape[0]
    padded = jnp.pad(points, ((0, -m % SEARCH_BLOCK), (0, 0)))
    own = jnp.pad(jnp.arange(m), (0, -m % SEARCH_BLOCK), constant_values=-1)

    def search(block):
        queries, idx = block
        distances = sum((queries[:, None, i] - points[None, :, i]) ** 2 for i in range(3))
        distances = jnp.where(usable[None], distances, jnp.inf)
        distances = jnp.where(idx[:, None] == jnp.arange(m)[None], -1.0, distances)
        return jax.lax.top_k(-distances, min(k, m))[1]

    blocks = (padded.reshape(-1, SEARCH_BLOCK, 3), own.reshape(-1, SEARCH_BLOCK))
    return jax.lax.map(search, blocks).reshape(padded.shape[0], -1)[:m]
