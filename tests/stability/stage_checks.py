"""Checks that the hard cases of all stages share: distributions, depths, and a loss for gradients."""

import jax
import jax.numpy as jnp
import numpy as np

PROBABILITY_SUM_ATOL = 1e-6  # a dozen float32 roundings
FLOAT32 = 1e-5  # absolute tolerance of values near 1
ZERO_GAMMA = -200.0  # raw value at which softplus underflows, so that gamma is 0


def check_distribution(probs) -> None:
    """Probabilities are nonnegative and sum to 1."""
    assert (np.asarray(probs) >= 0).all()
    np.testing.assert_allclose(np.asarray(probs, np.float64).sum(-1), 1.0, rtol=0, atol=PROBABILITY_SUM_ATOL)


def check_depths(depth, log_candidates) -> None:
    """Depths lie between the end candidates, and confidences in (0, 1]."""
    check_distribution(depth.probs)
    low, high = float(log_candidates.min()), float(log_candidates.max())
    assert (depth.log_depths >= low - FLOAT32).all() and (depth.log_depths <= high + FLOAT32).all()
    for confidences in (depth.matcher_confidences, depth.anchored_confidences):
        assert (confidences > 0).all() and (confidences <= 1).all()


def wave(tree):
    """A loss that depends on every entry of every leaf."""
    return sum(jnp.mean(jnp.sin(3 * x.astype(jnp.float32))) for x in jax.tree.leaves(tree))
