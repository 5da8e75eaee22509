"""The order in which steps show key views."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ssplat_jax.refinement.refine_config import RefineConfig

GOLDEN = 2654435769
"""2^32 over the golden ratio."""


def views_of_step(step: Int[Array, ""], valid: Bool[Array, " v"], config: RefineConfig) -> Int[Array, " b"]:
    """Slots of the views that a step shows.

    Args:
        step: number of the step, from 0.
        valid: slots that hold a view.
        config: gives `views_per_step` and the seed.
    """
    places = step * config.views_per_step + jnp.arange(config.views_per_step, dtype=jnp.int32)
    return jax.vmap(lambda place: next_view(place, valid, config.seed))(places)


def next_view(place: Int[Array, ""], valid: Bool[Array, " v"], seed: int) -> Int[Array, ""]:
    """Slot of the view at `place` in the sequence of all steps' views.

    Every valid view is shown once a round. Any few views in a row lie evenly among the valid ones, which are in the
    order of the stream: each part of the scene is seen about equally often. A round begins at a place of its own.

    Args:
        place: number of the view in the sequence, from 0.
        valid: slots that hold a view.
        seed: seed of the places at which rounds begin.
    """
    num_valid = jnp.maximum(jnp.sum(valid, dtype=jnp.int32), 1)
    begin = jax.random.uniform(jax.random.fold_in(jax.random.key(seed), place // num_valid), dtype=jnp.float32)
    ranks = jnp.cumsum(valid, dtype=jnp.int32) - 1
    order = jnp.argsort(jnp.where(valid, (golden_fractions(ranks) + begin) % 1.0, 2.0))
    return order[place % num_valid].astype(jnp.int32)


def golden_fractions(numbers: Int[Array, " n"]) -> Float[Array, " n"]:
    """Fractional parts of numbers over the golden ratio: those of any few numbers in a row lie evenly in [0, 1]."""
    return (numbers.astype(jnp.uint32) * jnp.uint32(GOLDEN)).astype(jnp.float32) / 2.0**32  # the product wraps around
