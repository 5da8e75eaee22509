"""3D token mixer of ReSplat's network: attention to 3D neighbors, then among all views at 1/16."""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ssplat_jax.config import StreamConfig
from ssplat_jax.model.convolution import Conv, pixel_shuffle, pixel_unshuffle
from ssplat_jax.model.layers import attend, attend_per_query
from ssplat_jax.model.nearest_tokens import nearest_tokens
from ssplat_jax.model.resplat.torch_layers import Mlp, layer_norm

GLOBAL_FACTOR = 4
"""Cells per side that the global block joins to one."""
HEADS = 4
"""Heads of the joint attention."""


class NeighborAttention(nn.Module):
    """One-head attention of each token to its 3D neighbors."""

    width: int

    @nn.compact
    def __call__(self, x, neighbors, usable):
        qkv = nn.Dense(3 * self.width, use_bias=False, name="qkv")(x)
        q, k, v = jnp.split(qkv, 3, axis=-1)
        return nn.Dense(x.shape[-1], name="proj")(attend_per_query(q, k[neighbors], v[neighbors], usable[neighbors]))


class NeighborBlock(nn.Module):
    """Pre-norm transformer block in which each token attends to its 3D neighbors."""

    width: int

    @nn.compact
    def __call__(self, x, neighbors, usable):
        x = x + NeighborAttention(self.width, name="attn")(layer_norm("norm1")(x), neighbors, usable)
        return x + Mlp(name="mlp")(layer_norm("norm2")(x))


class JointAttention(nn.Module):
    """Self-attention of all tokens."""

    @nn.compact
    def __call__(self, x, allowed):
        n, c = x.shape
        qkv = nn.Dense(3 * c, use_bias=False, name="qkv")(x).reshape(1, n, 3, HEADS, c // HEADS)
        return nn.Dense(c, name="proj")(attend(qkv[:, :, 0], qkv[:, :, 1], qkv[:, :, 2], allowed).reshape(n, c))


class JointBlock(nn.Module):
    """Pre-norm transformer block over all tokens."""

    @nn.compact
    def __call__(self, x, allowed):
        x = x + JointAttention(name="attn")(layer_norm("norm1")(x), allowed)
        return x + Mlp(name="mlp")(layer_norm("norm2")(x))


class GlobalBlock(nn.Module):
    """Transformer block over the tokens of all views at 1/16 of the image."""

    @nn.compact
    def __call__(self, x: Float[Array, "v h w c"], view_valid: Bool[Array, " v"]) -> Float[Array, "v h w c"]:
        v, c = x.shape[0], x.shape[-1]
        y = layer_norm("norm1")(nn.Dense(c, name="proj1")(pixel_unshuffle(x, GLOBAL_FACTOR)))
        tokens = y.reshape(-1, c)
        allowed = jnp.repeat(view_valid, tokens.shape[0] // v)[None, None]
        tokens = JointBlock(name="attn")(tokens, allowed)
        y = layer_norm("norm2")(nn.Dense(c * GLOBAL_FACTOR**2, name="proj2")(tokens.reshape(y.shape)))
        return x + Conv(c, name="conv")(pixel_shuffle(y, GLOBAL_FACTOR))


class Mixer(nn.Module):
    """Alternating neighbor blocks and global blocks."""

    config: StreamConfig

    @nn.compact
    def __call__(self, feats, positions, inside, view_valid):
        network = self.config.network
        neighbors = nearest_tokens(
            jax.lax.stop_gradient(positions), inside, network.mixer_neighbors, network.mixer_radius
        )
        x, usable = feats, inside.reshape(-1)
        for i in range(self.config.network.mixer_blocks):
            block = NeighborBlock(self.config.network.mixer_proj, name=f"blocks_{i}")
            x = block(x.reshape(-1, x.shape[-1]), neighbors, usable).reshape(x.shape)
            x = GlobalBlock(name=f"mv_blocks_{i}")(x, view_valid)
        return x


def mix_tokens(
    params,
    feats: Float[Array, "v hf wf c"],
    positions: Float[Array, "v hf wf 3"],
    inside: Bool[Array, "v hf wf"],
    view_valid: Bool[Array, " v"],
    config: StreamConfig,
) -> Float[Array, "v hf wf c"]:
    """Mixed token features, for the head and the cache."""
    if not config.network.mixer_blocks:
        return feats
    return feats + Mixer(config).apply({"params": params}, feats, positions, inside, view_valid)  # pyright: ignore
