"""Features and layers that the stages of the compact network share."""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from ssplat_jax.config import StreamConfig
from ssplat_jax.core.pytree import pytree
from ssplat_jax.model.layers import Conv, attend, attend_per_query, pixel_shuffle, pixel_unshuffle

GLOBAL_FACTOR = 4
"""Cells per side that the global block joins to one."""


@pytree
class CompactFeatures:
    """Output of the encoder."""

    fine: Float[Array, "v h2 w2 cm"]  # matching features at 1/2 of the padded image
    grid: Float[Array, "v hf wf cm"]  # matching features at 1/4, after cross-view attention
    context: Float[Array, "v hf wf c"]  # CNN and multi-view features at 1/4


class AttentionLayer(nn.Module):
    """Residual one-head attention in windows, with an optional feed-forward layer on [input, message]."""

    ffn_ratio: int = 0
    """Ratio of the feed-forward width to the feature width; 0 for no feed-forward layer."""

    @nn.compact
    def __call__(self, x, context, allowed=None):
        c = x.shape[-1]
        q = nn.Dense(c, use_bias=False, name="q")(x)
        k = nn.Dense(c, use_bias=False, name="k")(context)
        v = nn.Dense(c, use_bias=False, name="v")(context)
        message = attend(q[..., None, :], k[..., None, :], v[..., None, :], allowed)[..., 0, :]
        message = nn.LayerNorm(name="norm1")(nn.Dense(c, use_bias=False, name="merge")(message))
        if self.ffn_ratio:
            hidden = nn.Dense(self.ffn_ratio * c, use_bias=False, name="ffn1")(jnp.concatenate([x, message], axis=-1))
            message = nn.Dense(c, use_bias=False, name="ffn2")(nn.gelu(hidden, approximate=False))
            message = nn.LayerNorm(name="norm2")(message)
        return x + message


class NeighborBlock(nn.Module):
    """Pre-norm transformer block in which each token attends to its 3D neighbors."""

    config: StreamConfig

    @nn.compact
    def __call__(self, x, neighbors, usable):
        c = x.shape[-1]
        q, k, v = jnp.split(
            nn.Dense(3 * self.config.network.mixer_proj, use_bias=False, name="qkv")(nn.LayerNorm(name="norm1")(x)),
            3,
            axis=-1,
        )
        mixed = attend_per_query(q, k[neighbors], v[neighbors], usable[neighbors])
        x = x + nn.Dense(c, name="project")(mixed)
        hidden = nn.gelu(nn.Dense(2 * c, name="mlp1")(nn.LayerNorm(name="norm2")(x)))
        return x + nn.Dense(c, name="mlp2")(hidden)


class GlobalBlock(nn.Module):
    """Transformer block over the tokens of all views at 1/16 of the image."""

    heads: int = 4

    @nn.compact
    def __call__(self, x, view_valid):
        v, c = x.shape[0], x.shape[-1]
        y = nn.LayerNorm(name="norm_in")(nn.Dense(c, name="shrink")(pixel_unshuffle(x, GLOBAL_FACTOR)))
        tokens = y.reshape(1, -1, c)
        allowed = jnp.repeat(view_valid, tokens.shape[1] // v)[None, None]
        qkv = nn.Dense(3 * c, use_bias=False, name="qkv")(nn.LayerNorm(name="norm1")(tokens))
        qkv = qkv.reshape(1, tokens.shape[1], 3, self.heads, -1)
        mixed = attend(qkv[:, :, 0], qkv[:, :, 1], qkv[:, :, 2], allowed)
        tokens = tokens + nn.Dense(c, name="project")(mixed.reshape(tokens.shape))
        hidden = nn.gelu(nn.Dense(4 * c, name="mlp1")(nn.LayerNorm(name="norm2")(tokens)))
        tokens = tokens + nn.Dense(c, name="mlp2")(hidden)
        y = nn.LayerNorm(name="norm_out")(nn.Dense(c * GLOBAL_FACTOR**2, name="grow")(tokens.reshape(y.shape)))
        return x + Conv(c, kernel_init=nn.initializers.zeros, name="leave")(pixel_shuffle(y, GLOBAL_FACTOR))
