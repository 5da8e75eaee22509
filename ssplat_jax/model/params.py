"""Fresh parameters of every stage: plain nested dicts whose names are the checkpoint format."""

import functools
from collections.abc import Collection

import jax
import jax.numpy as jnp

from ssplat_jax.config import StreamConfig
from ssplat_jax.model.cgfi import Aggregator
from ssplat_jax.model.hpda import AnchorStrength
from ssplat_jax.model.network import network_of
from ssplat_jax.model.types import GRID_STRIDE

STAGES = ("encoder", "cost_volume", "hpda", "upsampler", "tokens", "cgfi", "mixer", "decoder")


def init_params(key: jax.Array, config: StreamConfig, only: Collection[str] | None = None) -> dict:
    """Parameters for `config`, drawn from `key`. Shapes depend on the configuration alone, never on an image.

    Of the stages in `only`, which are then what the whole would have; default all.
    """
    modules = _modules(config)
    names = [name for name in STAGES if name in modules]
    keys = jax.random.split(key, len(names))
    return {
        name: _init_stage(k, config, name) for k, name in zip(keys, names, strict=True) if only is None or name in only
    }


# A stage at a time: compiled as one, those of a large network take half as long again. Eagerly, every operation of
# every layer would be compiled by itself.
@functools.partial(jax.jit, static_argnums=(1, 2))
def _init_stage(key: jax.Array, config: StreamConfig, name: str) -> dict:
    module, inputs = _modules(config)[name]
    return module.init(key, *inputs).get("params", {})


def _modules(config: StreamConfig) -> dict:
    """Every stage with parameters, and inputs of the shapes that it takes."""
    v, side, c = 2, config.network.size_multiple // GRID_STRIDE, config.network.token_width
    grid = lambda channels: jnp.zeros((v, side, side, channels))  # noqa: E731
    return network_of(config).stages(config) | {
        "hpda": (AnchorStrength(config), ()),
        "cgfi": (Aggregator(config), (grid(c), grid(c + 1), jnp.ones(v, bool))),
    }


def count_params(params: dict) -> int:
    """Number of scalars in `params`."""
    return sum(leaf.size for leaf in jax.tree.leaves(params))
