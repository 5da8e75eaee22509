"""Fresh parameters of every stage: plain nested dicts whose names are the checkpoint format."""

import functools

import jax
import jax.numpy as jnp

from ssplat_jax.config import StreamConfig
from ssplat_jax.model.cgfi import Aggregator
from ssplat_jax.model.cost_volume import CostVolume
from ssplat_jax.model.decoder import GaussianHead
from ssplat_jax.model.encoder import Encoder
from ssplat_jax.model.hpda import AnchorStrength
from ssplat_jax.model.mixer import Mixer
from ssplat_jax.model.tokens import TokenRegressor


@functools.partial(jax.jit, static_argnums=1)  # eagerly, every layer's every operation would be compiled by itself
def init_params(key: jax.Array, config: StreamConfig) -> dict:
    """Parameters for `config`, drawn from `key`. Shapes depend on the configuration alone, never on an image."""
    v, side, c = 2, config.attention_window, config.token_width
    images = jnp.zeros((v, 4 * side, 4 * side, 3))
    sources = jnp.zeros((v, 1), jnp.int32)
    sources_valid = jnp.ones((v, 1), bool)
    grid = lambda channels: jnp.zeros((v, side, side, channels))  # noqa: E731
    inside, valid = jnp.ones((v, side, side), bool), jnp.ones(v, bool)
    levels = 2 if config.fine_matching else 1
    context = grid(2 * config.encoder_widths[1])
    stages = {
        "encoder": (Encoder(config), (images, sources, sources_valid)),
        "cost_volume": (CostVolume(config), (grid(levels * config.num_depths), context, valid)),
        "hpda": (AnchorStrength(config), ()),
        "tokens": (TokenRegressor(config), (grid(48), grid(1), grid(1), context, grid(config.unet_width))),
        "cgfi": (Aggregator(config), (grid(c), grid(c + 1), valid)),
        "mixer": (Mixer(config), (grid(c), grid(3), inside, valid)),
        "decoder": (GaussianHead(config), (jnp.zeros((1, c)),)),
    }
    keys = jax.random.split(key, len(stages))
    return {
        name: module.init(k, *inputs).get("params", {})
        for k, (name, (module, inputs)) in zip(keys, stages.items(), strict=True)
    }


def count_params(params: dict) -> int:
    """Number of scalars in `params`."""
    return sum(leaf.size for leaf in jax.tree.leaves(params))
