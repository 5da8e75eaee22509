"""Untrained parameters of all stages: nested dicts, whose names are part of the weights file format."""

import functools
from collections.abc import Collection

import jax
import jax.numpy as jnp

from ssplat_jax.config import StreamConfig
from ssplat_jax.core.errors import InputError
from ssplat_jax.model.cgfi import Aggregator, num_hints
from ssplat_jax.model.evidence import EvidenceHead, num_features
from ssplat_jax.model.hpda import AnchorStrength
from ssplat_jax.model.network import Network, network_of
from ssplat_jax.model.types import GRID_STRIDE

STAGES = ("encoder", "cost_volume", "hpda", "upsampler", "tokens", "cgfi", "mixer", "decoder", "evidence")
"""Names of the stages with parameters, in the order in which random keys are split among them."""


def init_params(key: jax.Array, config: StreamConfig, only: Collection[str] | None = None) -> dict:
    """Random parameters for `config`. Their shapes depend on the configuration alone, not on the image size.

    Args:
        key: JAX random key.
        config: model configuration.
        only: stages to return, with the values that they have among all stages; default all that are on.

    Raises:
        InputError: the network has a stage of an unknown name.
    """
    network = network_of(config)
    modules = _modules(config, network)
    if unknown := sorted(modules.keys() - set(STAGES)):
        raise InputError(f"network {config.network.kind!r}: wanted stages among {', '.join(STAGES)}, got {unknown}.")
    names = [name for name in STAGES if name in modules]
    keys = jax.random.split(key, len(names))  # a stage that is off has its key too, so that the others start alike
    wanted = set(names if only is None else only) - (set() if config.history.cgfi else {"cgfi"})
    return {name: _init_stage(k, config, name, network) for k, name in zip(keys, names, strict=True) if name in wanted}


# One program per stage: a single program for all stages of a large network takes 1.5 times as long to compile, and
# eager initialization compiles every operation of every layer by itself.
@functools.partial(jax.jit, static_argnums=(1, 2, 3))
def _init_stage(key: jax.Array, config: StreamConfig, name: str, network: Network) -> dict:
    module, inputs = _modules(config, network)[name]
    return module.init(key, *inputs).get("params", {})


def _modules(config: StreamConfig, network: Network) -> dict:
    """Linen module and example inputs of every stage."""
    v, side, c = 2, config.network.size_multiple // GRID_STRIDE, config.network.token_width
    grid = lambda channels: jnp.zeros((v, side, side, channels))  # noqa: E731
    evidence = {"evidence": (EvidenceHead(), (jnp.zeros((1, num_features())),))} if config.head.evidence else {}
    return (
        network.stages(config)
        | evidence
        | {
            "hpda": (AnchorStrength(config), ()),
            "cgfi": (Aggregator(config), (grid(c), grid(num_hints(config)), jnp.ones(v, bool))),
        }
    )


def complete_params(key: jax.Array, config: StreamConfig, params: dict) -> dict:
    """`params` with untrained parameters for each stage that `config` uses and that has none in them.

    Args:
        key: JAX random key; a stage gets the values that `init_params` gives it.
        config: model configuration.
        params: parameters of a model with fewer stages, such as `tiny` without CGFI and mixer.
    """
    untrained = init_params(key, config)
    return untrained | {name: params[name] for name, stage in untrained.items() if stage and params.get(name)}


def count_params(params: dict) -> int:
    """Number of scalars in `params`."""
    return sum(leaf.size for leaf in jax.tree.leaves(params))
