"""3D token mixer: attention among 3D neighbors, then among all views at 1/16 (ReSplat; ALGORITHM 3.2)."""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ssplat_jax.config import StreamConfig
from ssplat_jax.model.convolution import Conv, pixel_shuffle, pixel_unshuffle
from ssplat_jax.model.layers import attend, attend_own
from ssplat_jax.model.nearest_tokens import nearest_tokens
from ssplat_jax.model.resplat.swin_layers import Mlp

GLOBAL_FACTOR = 4  # the global block works on 4 x 4 cells
HEADS = 4


class NeighborAttention(nn.Module):
    """One-head attention of each token to its 3D neighbors."""

    width: int

    @nn.compact
    def __call__(self, x, neighbors, usable):
        qkv = nn.Dense(3 * self.width, use_bias=False, name="qkv")(x)
        q, k, v = jnp.split(qkv, 3, axis=-1)
        return nn.Dense(x.shape[-1], name="proj")(attend_own(q, k[neighbors], v[neighbors], usable[neighbors]))


class NeighborBlock(nn.Module):
    """Pre-norm attention of each token to its 3D neighbors, then an MLP."""

    width: int

    @nn.compact
    def __call__(self, x, neighbors, usable):
        norm = lambda name: nn.LayerNorm(epsilon=1e-5, use_fast_variance=False, name=name)  # noqa: E731
        x = x + NeighborAttention(self.width, name="attn")(norm("norm1")(x), neighbors, usable)
        return x + Mlp(name="mlp")(norm("norm2")(x))


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
        norm = lambda name: nn.LayerNorm(epsilon=1e-5, use_fast_variance=False, name=name)  # noqa: E731
        x = x + JointAttention(name="attn")(norm("norm1")(x), allowed)
        return x + Mlp(name="mlp")(norm("norm2")(x))


class GlobalBlock(nn.Module):
    """One transformer block over all views' tokens at 1/16 of the image, back to the grid by pixel shuffle."""

    @nn.compact
    def __call__(self, x: Float[Array, "v h w c"], view_valid: Bool[Array, " v"]) -> Float[Array, "v h w c"]:
        v, c = x.shape[0], x.shape[-1]
        norm = lambda name: nn.LayerNorm(epsilon=1e-5, use_fast_variance=False, name=name)  # noqa: E731
        y = norm("norm1")(nn.Dense(c, name="proj1")(pixel_unshuffle(x, GLOBAL_FACTOR)))
        tokens = y.reshape(-1, c)
        allowed = jnp.repeat(view_valid, tokens.shape[0] // v)[None, None]
        tokens = JointBlock(name="attn")(tokens, allowed)
        y = norm("norm2")(nn.Dense(c * GLOBAL_FACTOR**2, name="proj2")(tokens.reshape(y.shape)))
        return x + Conv(c, name="conv")(pixel_shuffle(y, GLOBAL_FACTOR))


class Mixer(nn.Module):
    """[kNN block, global block] repeated."""

    config: StreamConfig

    @nn.compact
    def __call__(self, feats, positions, inside, view_valid):
        neighbors = nearest_tokens(jax.lax.stop_gradient(positions), inside, self.config)
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
    """Context-aggregated token features, ready for the head and for the cache (DESIGN 6.8)."""
    if not config.network.mixer_blocks:
        return feats
    return feats + Mixer(config).apply({"params": params}, feats, positions, inside, view_valid)  # pyright: ignore
