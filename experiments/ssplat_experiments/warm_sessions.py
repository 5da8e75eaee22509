"""`new_session`: streams of the same configuration share their compiled programs."""

import functools

import jax

from ssplat_jax.config import StreamConfig
from ssplat_jax.model.network import complete_params
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.refinement import online_refinement
from ssplat_jax.storage.weights import load_params
from ssplat_jax.streaming.session import Session

MAX_KEPT = 4
"""Configurations whose programs are kept; the one that was used longest ago goes first."""


def new_session(config: StreamConfig) -> Session:
    """A session with an empty cache and the shipped weights, whose programs may be compiled already.

    Stages that the shipped weights lack are untrained.

    Two streams of one configuration must not be fed in turns: they are the same object.
    """
    session = _session(config)
    session.cache = None
    return session


def forget() -> None:
    """Keeps no programs any longer."""
    _session.cache_clear()


@functools.lru_cache(maxsize=MAX_KEPT)
def _session(config: StreamConfig) -> Session:
    model = StreamSplat(config)
    params = complete_params(jax.random.key(0), config, load_params("tiny"))
    return Session(model, params, revise=online_refinement(model))
