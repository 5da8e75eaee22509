"""3D token mixer: attention to 3D neighbors, then among all views at 1/16 (as in ReSplat)."""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ssplat_jax.config import StreamConfig
from ssplat_jax.model.convolution import Conv, pixel_shuffle, pixel_unshuffle
from ssplat_jax.model.layers import attend, attend_per_query, rms_normalize
from ssplat_jax.model.nearest_tokens import nearest_tokens

GLOBAL_FACTOR = 4
"""Cells per side that the global block joins to one."""


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


class Mixer(nn.Module):
    """Alternating neighbor blocks and global blocks."""

    config: StreamConfig

    def setup(self):
        self.local_blocks = [NeighborBlock(self.config) for _ in range(self.config.network.mixer_blocks)]
        self.global_blocks = [GlobalBlock() for _ in range(self.config.network.mixer_blocks)]

    def __call__(
        self,
        feats: Float[Array, "v hf wf c"],
        positions: Float[Array, "v hf wf 3"],
        inside: Bool[Array, "v hf wf"],
        view_valid: Bool[Array, " v"],
    ) -> Float[Array, "v hf wf c"]:
        if not self.local_blocks:
            return feats
        network = self.config.network
        neighbors = nearest_tokens(
            jax.lax.stop_gradient(positions), inside, network.mixer_neighbors, network.mixer_radius
        )
        x = feats
        for local, joint in zip(self.local_blocks, self.global_blocks, strict=True):
            flat = local(x.reshape(-1, x.shape[-1]), neighbors, inside.reshape(-1))
            x = joint(flat.reshape(x.shape), view_valid)
        return x


def mix_tokens(
    params,
    feats: Float[Array, "v hf wf c"],
    positions: Float[Array, "v hf wf 3"],
    inside: Bool[Array, "v hf wf"],
    view_valid: Bool[Array, " v"],
    config: StreamConfig,
) -> Float[Array, "v hf wf c"]:
    """Mixed token features, for the head and the cache; of unit RMS with `additions.unit_features`.

    Stored features come back through CGFI with the next chunk. Without a bound they grow from chunk to chunk: trained
    on four chunks, they reached 1e18 by the ninth. The input is brought to unit RMS too, because nothing else bounds
    what CGFI adds, and large features would outweigh the output of the blocks.
    """
    bound = rms_normalize if config.additions.unit_features else lambda x: x
    feats = bound(feats.astype(jnp.float32))
    mixed = Mixer(config).apply({"params": params}, feats, positions, inside, view_valid)
    return bound(mixed)  # pyright: ignore[reportArgumentType, reportReturnType]
