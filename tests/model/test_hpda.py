"""HPDA: the anchor, and how depth and confidence are read. Limits are in tests/stability/test_hpda_hard_cases.py."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.config import StreamConfig
from ssplat_jax.model.hpda import anchor_depth, expected_log_depth, peak_confidence
from ssplat_jax.model.views import DepthDistribution, prepare_views
from tests.model.small import chunk, history

D = 24
LOG_CANDIDATES = jnp.linspace(jnp.log(0.5), jnp.log(10.0), D)
CONFIG = StreamConfig().replace(num_depths=D, depth_readout="mean", hpda=True)
SHAPE = (2, 3, 4)
FLOAT32 = 1e-5


def distributions(seed: int = 0) -> jax.Array:
    return jax.nn.softmax(jnp.asarray(2 * np.random.default_rng(seed).normal(size=(*SHAPE, D)), jnp.float32))


@pytest.mark.parametrize(("readout", "half_width"), [("metric", 0), ("mean", 0), ("window", 1)])
def test_confidence_is_the_peak_or_the_largest_mass_of_neighbors(readout, half_width):
    probs = np.asarray(distributions(3), np.float64)
    sums = [probs[..., max(0, i - half_width) : i + half_width + 1].sum(-1) for i in range(D)]
    got = peak_confidence(distributions(3), CONFIG.replace(depth_readout=readout))
    np.testing.assert_allclose(got, np.max(sums, axis=0), atol=FLOAT32)


def test_window_readout_does_not_mix_two_surfaces():
    probs = jnp.zeros((1, D)).at[0, 3].set(0.55).at[0, 20].set(0.45)
    window = expected_log_depth(probs, LOG_CANDIDATES, CONFIG.replace(depth_readout="window"))
    mean = expected_log_depth(probs, LOG_CANDIDATES, CONFIG)
    np.testing.assert_allclose(window, LOG_CANDIDATES[3], atol=FLOAT32)
    np.testing.assert_allclose(mean, 0.55 * LOG_CANDIDATES[3] + 0.45 * LOG_CANDIDATES[20], atol=FLOAT32)


@pytest.mark.parametrize("space", ["log", "inverse"])
def test_metric_readout_is_the_mean_of_depths_in_any_space_of_candidates(space):
    config = CONFIG.replace(network="resplat").replace(depth_readout="metric", depth_space=space, num_depths=D)
    wanted = (np.asarray(distributions(), float) * np.exp(np.asarray(LOG_CANDIDATES, float))).sum(axis=-1)
    metric, mean = (
        jnp.exp(expected_log_depth(distributions(), LOG_CANDIDATES, config.replace(depth_readout=readout)))
        for readout in ("metric", "mean")
    )
    np.testing.assert_allclose(metric, wanted, rtol=FLOAT32)
    assert (np.asarray(mean) < wanted).all()  # Jensen: no other mean is as far


def views_and_distribution():
    config = CONFIG.replace(attention_window=4)
    views = prepare_views(chunk(views=2), config)
    shape = views.inside.shape
    probs = jax.nn.softmax(jnp.asarray(np.random.default_rng(5).normal(size=(*shape, D)), jnp.float32))
    return views, DepthDistribution(probs=probs, logits=jnp.log(probs), decoder=jnp.zeros((*shape, 8))), config


def test_matcher_confidence_does_not_depend_on_history():
    views, distribution, config = views_and_distribution()
    params = {"raw_gamma": jnp.float32(3.0)}
    shape = views.inside.shape
    blank = anchor_depth(params, distribution, history(np.zeros(shape), np.zeros(shape)), views, config)
    loud = anchor_depth(params, distribution, history(np.full(shape, 2.0), np.ones(shape)), views, config)
    np.testing.assert_array_equal(blank.matcher_confidences, loud.matcher_confidences)
    assert (loud.anchored_confidences > blank.anchored_confidences).mean() > 0.9
    np.testing.assert_array_equal(blank.probs, distribution.probs)
    np.testing.assert_allclose(np.asarray(loud.probs, np.float64).sum(-1), 1.0, atol=1e-6)
