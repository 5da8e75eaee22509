"""3D token mixer: attention among 3D neighbors, then among all views at 1/16 (ReSplat; ALGORITHM 3.2)."""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ssplat_jax.config import StreamConfig
from ssplat_jax.model.convolution import Conv, pixel_shuffle, pixel_unshuffle
from ssplat_jax.model.layers import attend, attend_own, rms_normalize
from ssplat_jax.model.nearest_tokens import nearest_tokens

GLOBAL_FACTOR = 4  # the global block works on 4 x 4 cells


class NeighborBlock(nn.Module):
    """Pre-norm attention of each token to its 3D neighbors, then an MLP."""

    config: StreamConfig

    @nn.compact
    def __call__(self, x, neighbors, usable):
        c = x.shape[-1]
        q, k, v = jnp.split(
            nn.Dense(3 * self.config.network.mixer_proj, use_bias=False, name="qkv")(nn.LayerNorm(name="norm1")(x)),
            3,
            axis=-1,
        )
        mixed = attend_own(q, k[neighbors], v[neighbors], usable[neighbors])
        x = x + nn.Dense(c, name="project")(mixed)
        hidden = nn.gelu(nn.Dense(2 * c, name="mlp1")(nn.LayerNorm(name="norm2")(x)))
        return x + nn.Dense(c, name="mlp2")(hidden)


class GlobalBlock(nn.Module):
    """One transformer block over all views' tokens at 1/16 of the image, back to the grid by pixel shuffle."""

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
    """[kNN block, global block] repeated; the result is added to the tokens."""

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
        neighbors = nearest_tokens(jax.lax.stop_gradient(positions), inside, self.config)
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
    """Context-aggregated token features, ready for the head and for the cache (DESIGN 6.8).

    They have unit RMS. What is stored comes back through CGFI a chunk later, so without a bound the stream is a loop
    with gain: trained on four chunks, features grew to 1e18 by the ninth. The head normalizes anyway.
    What comes in is brought to unit RMS too: nothing else holds the size of what CGFI adds, and the blocks would drown
    in it.
    """
    feats = rms_normalize(feats.astype(jnp.float32))  # pyright: ignore[reportAssignmentType]
    mixed = Mixer(config).apply({"params": params}, feats, positions, inside, view_valid)
    return rms_normalize(mixed)  # pyright: ignore[reportArgumentType]
