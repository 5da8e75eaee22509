"""Tokens of ReSplat's network: features of the current views, their mixing in 3D, and the shapes read from them."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ssplat_jax.config import StreamConfig
from ssplat_jax.model.layers import Conv, attend, attend_per_query, nearest_tokens, pixel_shuffle, pixel_unshuffle
from ssplat_jax.model.resplat.torch_layers import Mlp, ReSplatFeatures, layer_norm, resize
from ssplat_jax.model.views import GRID_STRIDE, AnchoredDepth, DepthDistribution, TokenShapes, Views, repeat_cells


class TokenRegressor(nn.Module):
    """Maps [patch, depth, match probability, context] to f, with a skip for all but the depth."""

    config: StreamConfig

    @nn.compact
    def __call__(self, patches, depths, match, features) -> Float[Array, "v hf wf c"]:
        c = self.config.network.token_width
        x = jnp.concatenate([patches, depths, match, features], axis=-1)
        x = nn.gelu(Conv(c, name="gaussian_regressor_0")(x), approximate=False)
        x = Conv(c, name="gaussian_regressor_2")(x)
        return nn.Dense(c, name="proj")(jnp.concatenate([x, patches, features, match], axis=-1))


def token_context(features: ReSplatFeatures, height: int, width: int) -> Float[Array, "v hf wf c"]:
    """Encoder features on a grid of `height` x `width` cells: ViT, CNN, multi-view."""
    mono = [pixel_shuffle(resize(x, height // 4, width // 4), 4) for x in features.mono]
    maps = [resize(x, height, width) for x in (*features.cnn, features.multiview)]
    return jnp.concatenate([*mono, *maps], axis=-1)


def regress_tokens(
    params,
    features: ReSplatFeatures,
    distribution: DepthDistribution,
    depth: AnchoredDepth,
    views: Views,
    config: StreamConfig,
) -> Float[Array, "v hf wf c"]:
    """Token features f^v(u) of the current views."""
    del distribution  # the match probability is that of the anchored depth
    _, hf, wf = depth.log_depths.shape
    patches = pixel_unshuffle(views.images, GRID_STRIDE)
    match = repeat_cells(depth.probs.max(axis=-1, keepdims=True), config.network.match_stride // GRID_STRIDE)
    context = token_context(features, hf, wf)
    depths = jnp.exp(depth.log_depths)[..., None]
    return TokenRegressor(config).apply({"params": params}, patches, depths, match, context)  # pyright: ignore[reportReturnType]


# -- 3D token mixer: attention to 3D neighbors, then among all views at 1/16 ------------------------------------------

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


# -- Gaussian head: a two-layer MLP -----------------------------------------------------------------------------------

ROWS = (4, 3, 1, 2)
"""Widths of rotation (xyzw), scale, opacity and offset in the output; color coefficients follow. The offset in the
pixel is not used: a pivot's Gaussian is at the pivot's position."""


class GaussianHead(nn.Module):
    """Maps features to raw rotation, scale, opacity, offset and SH residual."""

    config: StreamConfig

    @nn.compact
    def __call__(self, feats: Float[Array, "m c"]) -> Float[Array, "m o"]:
        outputs = sum(ROWS) + 3 * (self.config.head.sh_degree + 1) ** 2
        hidden = nn.gelu(nn.Dense(outputs, name="gaussian_head_0")(feats), approximate=False)
        return nn.Dense(outputs, kernel_init=nn.initializers.normal(1e-3), name="gaussian_head_2")(hidden)


def read_shapes(params, feats: Float[Array, "m c"], config: StreamConfig) -> TokenShapes:
    """Shapes predicted from features of any float dtype, in float32."""
    raw = GaussianHead(config).apply({"params": params}, feats.astype(jnp.float32))
    rotation, scale, opacity, _, sh = jnp.split(raw, np.cumsum(ROWS).tolist(), axis=-1)  # pyright: ignore[reportArgumentType]
    return TokenShapes(
        logit_opacities=opacity[:, 0],
        raw_scales=scale,
        quats=jnp.roll(rotation, 1, axis=-1),
        sh=sh.reshape(feats.shape[0], 3, -1).swapaxes(1, 2),
    )
