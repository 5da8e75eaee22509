"""Our own network for a CPU: the stages of `StreamSplat` by their common names."""

import jax.numpy as jnp

from ssplat_jax.config import StreamConfig
from ssplat_jax.model.cost_volume import CostVolume
from ssplat_jax.model.cost_volume import match as match
from ssplat_jax.model.decoder import GaussianHead
from ssplat_jax.model.decoder import read_shapes as read_shapes
from ssplat_jax.model.encoder import Encoder
from ssplat_jax.model.encoder import encode as encode
from ssplat_jax.model.mixer import Mixer
from ssplat_jax.model.mixer import mix_tokens as mix_tokens
from ssplat_jax.model.tokens import TokenRegressor
from ssplat_jax.model.tokens import regress_tokens as regress_tokens
from ssplat_jax.model.wires import AnchoredDepth


def refine_depth(params, features, depth: AnchoredDepth, views, config) -> AnchoredDepth:
    """`depth`: the match grid is that of the tokens."""
    del params, features, views, config
    return depth


def modules(config: StreamConfig) -> dict:
    """Every stage with parameters of its own, and inputs of the shapes that it takes."""
    v, side, c = 2, config.attention_window, config.token_width
    images = jnp.zeros((v, 4 * side, 4 * side, 3))
    sources = jnp.zeros((v, 1), jnp.int32)
    sources_valid = jnp.ones((v, 1), bool)
    grid = lambda channels: jnp.zeros((v, side, side, channels))  # noqa: E731
    inside, valid = jnp.ones((v, side, side), bool), jnp.ones(v, bool)
    levels = 2 if config.fine_matching else 1
    context = grid(2 * config.encoder_widths[1])
    return {
        "encoder": (Encoder(config), (images, sources, sources_valid)),
        "cost_volume": (CostVolume(config), (grid(levels * config.num_depths), context, valid)),
        "tokens": (TokenRegressor(config), (grid(48), grid(1), grid(1), context, grid(config.unet_width))),
        "mixer": (Mixer(config), (grid(c), grid(3), inside, valid)),
        "decoder": (GaussianHead(config), (jnp.zeros((1, c)),)),
    }
