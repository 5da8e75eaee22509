"""HPDA: how history changes depth distributions, and the limits."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.config import StreamConfig
from ssplat_jax.core.pytree import replace
from ssplat_jax.model.hpda import (
    RECALL_MARGIN,
    RECALL_SUPPORT,
    RECALL_WINDOW,
    anchor_depth,
    cache_anchor,
    expected_log_depth,
    inject_anchor,
    peak_confidence,
)
from ssplat_jax.model.types import DepthDistribution, prepare_views
from tests.model.small import chunk, finite, history

D = 24
LOG_CANDIDATES = jnp.linspace(jnp.log(0.5), jnp.log(10.0), D)
CONFIG = StreamConfig().replace(num_depths=D, depth_readout="mean", hpda=True)
SHAPE = (2, 3, 4)
FLOAT32 = 1e-5


def distributions(seed: int = 0) -> jax.Array:
    return jax.nn.softmax(jnp.asarray(2 * np.random.default_rng(seed).normal(size=(*SHAPE, D)), jnp.float32))


def memories(seed: int = 1):
    """History with depths over the whole range and confidences in (0, 1]; every third cell is a hole."""
    rng = np.random.default_rng(seed)
    depths, confidences = np.exp(rng.uniform(np.log(0.5), np.log(10), SHAPE)), rng.uniform(0.05, 1, SHAPE)
    hole = np.arange(np.prod(SHAPE)).reshape(SHAPE) % 3 == 0
    return history(np.where(hole, 0, depths), np.where(hole, 0, confidences)), hole


def gamma(value) -> jax.Array:
    return jnp.float32(value)


@pytest.mark.parametrize("space", ["log", "metric"])
def test_anchor_is_the_gaussian_of_the_paper(space):
    past, hole = memories()
    config = CONFIG.replace(anchor_space=space, sigma0=0.2, lambda_sigma=0.7)
    omega, depths = np.asarray(past.confidences, float)[..., None], np.asarray(past.depths, float)[..., None]
    candidates = np.asarray(LOG_CANDIDATES, float)
    with np.errstate(divide="ignore"):
        offsets = candidates - np.log(depths) if space == "log" else np.exp(candidates) - depths
    wanted = omega * np.exp(-(offsets**2) / (2 * (0.2 + 0.7 * (1 - omega)) ** 2))
    got = cache_anchor(past, LOG_CANDIDATES, config)
    np.testing.assert_allclose(got, np.where(hole[..., None], 0, wanted), atol=FLOAT32)


@pytest.mark.parametrize("strength", [0.0, 0.1, 1e6])
def test_hole_keeps_the_distribution_bit_for_bit(strength):
    past, hole = memories()
    probs = distributions()
    mixed = inject_anchor(probs, cache_anchor(past, LOG_CANDIDATES, CONFIG), gamma(strength))
    np.testing.assert_array_equal(np.asarray(mixed)[hole], np.asarray(probs)[hole])
    if strength:
        assert (np.asarray(mixed)[~hole] != np.asarray(probs)[~hole]).any(-1).all()


@pytest.mark.parametrize("strength", [0.0, 1e-6, 0.1, 10.0, 1e6])
@pytest.mark.parametrize(
    "options", [{}, {"anchor_space": "metric"}, {"anchor_norm": "mass"}, {"sigma0": 1e-9}], ids=str
)
def test_mixture_is_a_distribution_with_finite_gradients(strength, options):
    past, _ = memories()
    config = CONFIG.replace(**options)

    def mix(logits, g):
        return inject_anchor(jax.nn.softmax(logits), cache_anchor(past, LOG_CANDIDATES, config), g)

    logits = jnp.log(distributions())
    mixed = mix(logits, gamma(strength))
    assert (mixed >= 0).all()
    np.testing.assert_allclose(np.asarray(mixed, np.float64).sum(-1), 1.0, rtol=0, atol=1e-6)
    weight = jnp.arange(D, dtype=jnp.float32)
    assert finite(jax.grad(lambda *x: jnp.sum(mix(*x) * weight), (0, 1))(logits, gamma(strength)))


def test_larger_gamma_moves_depth_monotonically_to_history():
    past, hole = memories()
    anchor = cache_anchor(past, LOG_CANDIDATES, CONFIG)
    read = lambda g: expected_log_depth(inject_anchor(distributions(), anchor, gamma(g)), LOG_CANDIDATES, CONFIG)  # noqa: E731
    goal = read(1e6)  # the anchor alone
    distances = np.stack([np.abs(np.asarray(read(g) - goal))[~hole] for g in (0, 0.01, 0.03, 0.1, 0.3, 1, 3, 10, 100)])
    assert (np.diff(distances, axis=0) <= FLOAT32).all()
    assert (distances[-1] < 0.1 * distances[0] + FLOAT32).all()


def test_huge_gamma_gives_the_cached_depth():
    past = history(np.full(SHAPE, 2.0), np.full(SHAPE, 1.0))
    mixed = inject_anchor(distributions(), cache_anchor(past, LOG_CANDIDATES, CONFIG), gamma(1e6))
    np.testing.assert_allclose(expected_log_depth(mixed, LOG_CANDIDATES, CONFIG), np.log(2.0), atol=0.01)


def test_gamma_zero_is_no_anchor_bit_for_bit():
    past, _ = memories()
    for strength in (0.0, 1e-30):
        mixed = inject_anchor(distributions(), cache_anchor(past, LOG_CANDIDATES, CONFIG), gamma(strength))
        np.testing.assert_array_equal(mixed, distributions())


def test_sigma_to_zero_is_one_candidate_or_none():
    on, between = float(jnp.exp(LOG_CANDIDATES[5])), float(jnp.exp(0.5 * (LOG_CANDIDATES[5] + LOG_CANDIDATES[6])))
    past = history([[[on, between]]], [[[1.0, 1.0]]])
    probs = jnp.full((1, 1, 2, D), 1.0 / D)
    mixed = inject_anchor(probs, cache_anchor(past, LOG_CANDIDATES, CONFIG.replace(sigma0=1e-5)), gamma(1e6))
    assert mixed[0, 0, 0, 5] > 0.999
    np.testing.assert_array_equal(mixed[0, 0, 1], probs[0, 0, 1])  # history fits no candidate: bit for bit


def test_less_confident_history_is_wider_and_lower():
    sure, unsure = (cache_anchor(history([[[2.0]]], [[[w]]]), LOG_CANDIDATES, CONFIG)[0, 0, 0] for w in (1.0, 0.3))
    assert sure.max() > unsure.max()
    width = lambda a: float(jnp.sum(a) / jnp.max(a))  # noqa: E731
    assert width(unsure) > 2 * width(sure)


def test_mass_norm_makes_gamma_the_odds_of_history():
    past = history(np.full(SHAPE, 2.0), np.full(SHAPE, 0.6))
    anchor = cache_anchor(past, LOG_CANDIDATES, CONFIG.replace(anchor_norm="mass"))
    np.testing.assert_allclose(anchor.sum(-1), 0.6, atol=FLOAT32)


@pytest.mark.parametrize("half_width", [0, 1, 3])
def test_window_confidence_is_the_largest_mass_of_neighbors(half_width):
    config = CONFIG.replace(confidence="window", confidence_window=half_width)
    probs = np.asarray(distributions(3), np.float64)
    sums = [probs[..., max(0, i - half_width) : i + half_width + 1].sum(-1) for i in range(D)]
    np.testing.assert_allclose(peak_confidence(distributions(3), config), np.max(sums, axis=0), atol=FLOAT32)
    if half_width == 0:
        peak = peak_confidence(distributions(3), CONFIG.replace(confidence="peak"))
        np.testing.assert_allclose(peak, np.max(sums, axis=0), atol=FLOAT32)


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


def test_metric_readout_of_one_candidate_is_its_depth_with_a_zero_gradient():
    config = CONFIG.replace(depth_readout="metric")
    one_hot = jnp.eye(D)[7]
    np.testing.assert_allclose(expected_log_depth(one_hot, LOG_CANDIDATES, config), LOG_CANDIDATES[7], rtol=1e-6)
    read = lambda logit: expected_log_depth(jax.nn.softmax(logit[None]), jnp.log(jnp.array([3.0])), config)  # noqa: E731
    value, slope = jax.value_and_grad(read)(gamma(2.0))
    assert float(value) == pytest.approx(np.log(3.0), rel=1e-6) and float(slope) == 0.0


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


def test_hpda_switched_off_keeps_the_distribution():
    views, distribution, config = views_and_distribution()
    shape = views.inside.shape
    off = anchor_depth(
        {}, distribution, history(np.full(shape, 2.0), np.ones(shape)), views, config.replace(hpda=False)
    )
    np.testing.assert_array_equal(off.probs, distribution.probs)


def recalling(recall: bool):
    """Depth with a matcher and a history that are sure of some cells; every third cell of the history is a hole."""
    views, distribution, config = views_and_distribution()
    rng, shape = np.random.default_rng(7), views.inside.shape
    distribution = replace(distribution, probs=jax.nn.softmax(2 * distribution.logits))
    depths, confidences = np.exp(rng.uniform(-1, 3, shape)), rng.uniform(0.3, 0.95, shape)
    depths[rng.uniform(size=shape) < 1 / 3] = 0
    past = history(depths, np.where(depths > 0, confidences, 0))
    config = config.replace(recall=recall, min_confidence=0.5)
    read = anchor_depth({"raw_gamma": jnp.float32(-2.0)}, distribution, past, views, config)
    return read, distribution.probs, past, config


def test_recalled_cells_take_depth_and_confidence_from_the_history():
    (plain, matched, _, _), (recalled, _, past, config) = recalling(False), recalling(True)
    tau, shape = config.memory.min_confidence, plain.log_depths.shape
    wanted_depths, wanted_confidences = (np.array(x) for x in (plain.log_depths, plain.matcher_confidences))
    candidates, probs = np.asarray(views_and_distribution()[0].log_candidates, float), np.asarray(matched, float)
    low, high = np.exp(candidates[[0, -1]])
    count, contradicted = 0, 0
    for cell in np.ndindex(shape):
        in_range = low <= float(past.depths[cell]) <= high
        sure_of_it = float(past.confidences[cell]) > tau + RECALL_MARGIN and bool(past.mask[cell]) and in_range
        if not (sure_of_it and wanted_confidences[cell] < tau):
            continue
        nearest = int(np.argmin(np.abs(candidates - np.log(float(past.depths[cell])))))
        support = probs[cell][max(nearest - RECALL_WINDOW, 0) : nearest + RECALL_WINDOW + 1].sum()
        contradicted += support < RECALL_SUPPORT
        if support >= RECALL_SUPPORT:
            wanted_depths[cell], wanted_confidences[cell] = np.log(past.depths[cell]), tau + RECALL_MARGIN
            count += 1
    assert count >= 3 and contradicted >= 3  # there is something to recall, and something to keep
    np.testing.assert_allclose(recalled.log_depths, wanted_depths, rtol=1e-6)
    np.testing.assert_allclose(recalled.matcher_confidences, wanted_confidences, rtol=1e-6)
    kept = wanted_confidences == np.asarray(plain.matcher_confidences)
    np.testing.assert_array_equal(np.asarray(recalled.log_depths)[kept], np.asarray(plain.log_depths)[kept])
    np.testing.assert_array_equal(recalled.anchored_confidences, plain.anchored_confidences)


def test_recalled_depth_is_not_recalled_again():
    """The confidence that recalled tokens get is no history to recall from."""
    views, distribution, config = views_and_distribution()
    shape, config = views.inside.shape, config.replace(recall=True, min_confidence=0.5)
    flat = replace(distribution, probs=jnp.full((*shape, D), 1 / D))
    past = history(np.full(shape, 3.0), np.full(shape, np.float32(0.5 + RECALL_MARGIN)))
    read = anchor_depth({"raw_gamma": jnp.float32(-2.0)}, flat, past, views, config)
    assert (np.asarray(read.matcher_confidences) < 0.5).all()
    assert (np.abs(np.asarray(read.log_depths) - np.log(3.0)) > 1e-3).any()


def test_recalled_depth_has_no_gradient_and_others_keep_theirs():
    views, distribution, config = views_and_distribution()
    shape, config = views.inside.shape, config.replace(recall=True, min_confidence=0.5)
    known = np.arange(np.prod(shape)).reshape(shape) % 2 == 0
    past = history(np.where(known, 3.0, 0.0), np.where(known, 0.9, 0.0))

    def total(logits):
        given = replace(distribution, probs=jax.nn.softmax(logits))
        return anchor_depth({"raw_gamma": jnp.float32(-2.0)}, given, past, views, config).log_depths.sum()

    logits = jnp.zeros((*shape, D)).at[..., 3].set(0.5)
    slopes = np.abs(np.asarray(jax.grad(total)(logits))).max(axis=-1)
    assert np.isfinite(slopes).all()
    assert (slopes[known] == 0).all() and (slopes[~known] > 0).all()
