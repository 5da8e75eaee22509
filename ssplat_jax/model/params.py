"""Fresh parameters of every stage: plain nested dicts whose names are the checkpoint format."""

import functools

import jax
import jax.numpy as jnp

from ssplat_jax.config import StreamConfig
from ssplat_jax.model.cgfi import Aggregator
from ssplat_jax.model.hpda import AnchorStrength
from ssplat_jax.model.networks import network_of
from ssplat_jax.model.wires import GRID_STRIDE

STAGES = ("encoder", "cost_volume", "hpda", "upsampler", "tokens", "cgfi", "mixer", "decoder")


@functools.partial(jax.jit, static_argnums=1)  # eagerly, every layer's every operation would be compiled by itself
def init_params(key: jax.Array, config: StreamConfig) -> dict:
    """Parameters for `config`, drawn from `key`. Shapes depend on the configuration alone, never on an image."""
    v, side, c = 2, config.size_multiple // GRID_STRIDE, config.token_width
    grid = lambda channels: jnp.zeros((v, side, side, channels))  # noqa: E731
    modules = network_of(config).modules(config) | {
        "hpda": (AnchorStrength(config), ()),
        "cgfi": (Aggregator(config), (grid(c), grid(c + 1), jnp.ones(v, bool))),
    }
    names = [name for name in STAGES if name in modules]
    keys = jax.random.split(key, len(names))
    parts = {name: modules[name][0].init(k, *modules[name][1]) for k, name in zip(keys, names, strict=True)}
    return {name: part.get("params", {}) for name, part in parts.items()}


def count_params(params: dict) -> int:
    """Number of scalars in `params`."""
    return sum(leaf.size for leaf in jax.tree.leaves(params))
