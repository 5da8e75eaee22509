"""The tokens that a token's neighbors in 3D are (ReSplat; ALGORITHM 3.2)."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ssplat_jax.config import StreamConfig

SEARCH_BLOCK = 1024  # queries at a time in the global search: bounds its distance matrix


def nearest_tokens(
    positions: Float[Array, "v hf wf 3"], inside: Bool[Array, "v hf wf"], config: StreamConfig
) -> Int[Array, "m k"]:
    """Flat indices of each token's nearest tokens in 3D, itself first.

    Tokens outside the image are chosen last; a neighborhood with fewer real tokens repeats what it has.
    """
    if config.network.mixer_radius == 0:
        return _nearest_of_all(positions.reshape(-1, 3), inside.reshape(-1), config.network.mixer_neighbors)
    v, hf, wf, _ = positions.shape
    radius = config.network.mixer_radius
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
    # A patch that sticks out of the grid reads border cells twice: only the first reading counts.
    distances = jnp.where(usable[candidates] & in_grid, jnp.sum(offsets**2, axis=-1), jnp.inf)
    distances = distances.at[:, side * side // 2].set(-1.0)  # itself
    _, best = jax.lax.top_k(-distances, min(config.network.mixer_neighbors, side * side))
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
