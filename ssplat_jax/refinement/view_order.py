"""The order in which steps show key views."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from ssplat_jax.refinement.refine_config import RefineConfig


def views_of_step(step: Int[Array, ""], valid: Bool[Array, " v"], config: RefineConfig) -> Int[Array, " b"]:
    """Slots of the views that a step shows."""
    places = step * config.views_per_step + jnp.arange(config.views_per_step)
    return jax.vmap(lambda place: next_view(place, valid, config.seed))(places)


def next_view(place: Int[Array, ""], valid: Bool[Array, " v"], seed: int) -> Int[Array, ""]:
    """Slot of the view at `place` in the sequence of all steps' views.

    Every valid view is shown once a round, in an order drawn anew for each round.
    """
    num_valid = jnp.maximum(jnp.sum(valid, dtype=jnp.int32), 1)
    key = jax.random.fold_in(jax.random.key(seed), place // num_valid)
    order = jnp.argsort(jnp.where(valid, jax.random.uniform(key, valid.shape), 2.0))
    return order[place % num_valid].astype(jnp.int32)
