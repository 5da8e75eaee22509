"""3D token mixer: attention of each token to its neighbors in space, then among all views at 1/16 (as in ReSplat)."""

import functools
from collections.abc import Callable

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ssplat_jax.config import StreamConfig
from ssplat_jax.core.cpu_backend import lane_sum
from ssplat_jax.model.layers import Conv, Mlp, SelfAttention, layer_norm, pixel_shuffle, pixel_unshuffle

SEARCH_BLOCK = 1024  # queries per block of the search for neighbors, which bounds the size of its distance matrix
GLOBAL_FACTOR = 4  # cells per side that the global block joins to one
HEADS = 4  # heads of the joint attention


class NeighborAttention(nn.Module):
    """One-head attention of each token to its 3D neighbors."""

    width: int

    @nn.compact
    def __call__(self, x, neighbors, usable):
        qkv = nn.Dense(3 * self.width, use_bias=False, name="qkv")(x)
        q, k, v = jnp.split(qkv, 3, axis=-1)
        return nn.Dense(x.shape[-1], name="proj")(attend_per_query(q, k[neighbors], v[neighbors], usable[neighbors]))


class MixerBlock(nn.Module):
    """Pre-norm transformer block; `attention` takes the tokens and what else the block is given."""

    attention: Callable[..., nn.Module]

    @nn.compact
    def __call__(self, x, *given):
        x = x + self.attention(name="attn")(layer_norm("norm1")(x), *given)
        return x + Mlp(name="mlp")(layer_norm("norm2")(x))


class GlobalBlock(nn.Module):
    """Transformer block over the tokens of all views at 1/16 of the image."""

    @nn.compact
    def __call__(self, x: Float[Array, "v h w c"], view_valid: Bool[Array, " v"]) -> Float[Array, "v h w c"]:
        v, c = x.shape[0], x.shape[-1]
        y = layer_norm("norm1")(nn.Dense(c, name="proj1")(pixel_unshuffle(x, GLOBAL_FACTOR)))
        tokens = y.reshape(1, -1, c)
        allowed = jnp.repeat(view_valid, tokens.shape[1] // v)[None, None]
        tokens = MixerBlock(functools.partial(SelfAttention, HEADS, use_bias=False), name="attn")(tokens, allowed)
        y = layer_norm("norm2")(nn.Dense(c * GLOBAL_FACTOR**2, name="proj2")(tokens.reshape(y.shape)))
        return x + Conv(c, name="conv")(pixel_shuffle(y, GLOBAL_FACTOR))


class Mixer(nn.Module):
    """Alternating neighbor blocks and global blocks; features stay as they are with `mixer_blocks=0`.

    Args:
        feats: token features.
        positions: token positions, stream frame; no gradient flows to them.
        inside: tokens in the image.
        view_valid: views that are no padding.
    """

    config: StreamConfig

    @nn.compact
    def __call__(
        self,
        feats: Float[Array, "v hf wf c"],
        positions: Float[Array, "v hf wf 3"],
        inside: Bool[Array, "v hf wf"],
        view_valid: Bool[Array, " v"],
    ) -> Float[Array, "v hf wf c"]:
        network = self.config.network
        if not network.mixer_blocks:
            return feats
        constants = jax.lax.stop_gradient(positions)
        neighbors = nearest_tokens(constants, inside, network.mixer_neighbors, network.mixer_radius)
        x, usable = feats, inside.reshape(-1)
        for i in range(network.mixer_blocks):
            block = MixerBlock(functools.partial(NeighborAttention, network.mixer_proj), name=f"blocks_{i}")
            x = block(x.reshape(-1, x.shape[-1]), neighbors, usable).reshape(x.shape)
            x = GlobalBlock(name=f"mv_blocks_{i}")(x, view_valid)
        return x


def nearest_tokens(
    positions: Float[Array, "v hf wf 3"], inside: Bool[Array, "v hf wf"], num_neighbors: int, radius: int
) -> Int[Array, "m k"]:
    """Flat indices of each token's nearest tokens in 3D, the token itself first.

    Args:
        positions: token positions, stream frame.
        inside: tokens in the image. Others are chosen last.
        num_neighbors: per token, itself included; fewer where there are not so many candidates.
        radius: candidates are the (2 r + 1)^2 cells around a token in its own view; 0 for all tokens of all views.
    """
    if radius == 0:
        return _nearest_of_all(positions.reshape(-1, 3), inside.reshape(-1), num_neighbors)
    v, hf, wf, _ = positions.shape
    side = 2 * radius + 1
    flat = jnp.arange(v * hf * wf).reshape(v, hf, wf)
    rows, columns = (jnp.arange(n)[:, None] + jnp.arange(side) - radius for n in (hf, wf))
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


def attend_per_query(
    queries: Float[Array, "m c"],
    keys: Float[Array, "m k c"],
    values: Float[Array, "m k c"],
    allowed: Bool[Array, "m k"],
) -> Float[Array, "m c"]:
    """One-head attention where every query has a few keys of its own.

    `attend` would compute products of one-row matrices, which are four times slower on a CPU.

    Limits:
        A query without an `allowed` key gives zeros.
    """
    scores = lane_sum(queries[:, None] * keys).astype(jnp.float32) * queries.shape[-1] ** -0.5
    weights = jax.nn.softmax(jnp.where(allowed, scores, -1e9), axis=-1) * allowed.astype(jnp.float32)
    return jnp.sum(weights.astype(values.dtype)[..., None] * values, axis=-2)
