"""The compact network, small enough for a CPU: its stages put together."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ssplat_jax.config import StreamConfig
from ssplat_jax.model.compact.cnn_encoder import Encoder, encode
from ssplat_jax.model.compact.compact_tokens import (
    GaussianHead,
    Mixer,
    TokenRegressor,
    mix_tokens,
    read_shapes,
    regress_tokens,
)
from ssplat_jax.model.compact.sweep_matching import CostVolume, match
from ssplat_jax.model.views import AnchoredDepth


def refine_depth(params, features, depth: AnchoredDepth, views, config: StreamConfig) -> AnchoredDepth:
    """`depth` unchanged: the matching grid is the feature grid."""
    del params, features, views, config
    return depth


def bound_history(feats: Float[Array, "v hf wf c"]) -> Float[Array, "v hf wf c"]:
    """`feats` unchanged: `mix_tokens` ends in a norm."""
    return feats


def stages(config: StreamConfig) -> dict:
    """Linen module and example inputs of every stage."""
    v, side, c = 2, config.network.attention_window, config.network.token_width
    images = jnp.zeros((v, 4 * side, 4 * side, 3))
    sources = jnp.zeros((v, 1), jnp.int32)
    sources_valid = jnp.ones((v, 1), bool)
    grid = lambda channels: jnp.zeros((v, side, side, channels))  # noqa: E731
    inside, valid = jnp.ones((v, side, side), bool), jnp.ones(v, bool)
    levels = 2 if config.network.fine_matching else 1
    context = grid(2 * config.network.encoder_widths[1])
    return {
        "encoder": (Encoder(config), (images, sources, sources_valid)),
        "cost_volume": (CostVolume(config), (grid(levels * config.network.num_depths), context, valid)),
        "tokens": (TokenRegressor(config), (grid(48), grid(1), grid(1), context, grid(config.network.unet_width))),
        "mixer": (Mixer(config), (grid(c), grid(3), inside, valid)),
        "decoder": (GaussianHead(config), (jnp.zeros((1, c)),)),
    }


class CompactNetwork:
    """The stages of the compact network; fulfils `ssplat_jax.model.network.Network`."""

    stages = staticmethod(stages)
    encode = staticmethod(encode)
    match = staticmethod(match)
    refine_depth = staticmethod(refine_depth)
    regress_tokens = staticmethod(regress_tokens)
    bound_history = staticmethod(bound_history)
    mix_tokens = staticmethod(mix_tokens)
    read_shapes = staticmethod(read_shapes)
