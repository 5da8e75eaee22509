"""HPDA: hard cases, one small program per configuration, and how depth and confidence are read.

Values and gradients must be finite, distributions nonnegative with sum 1, and limits reached where they exist.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.core.numerics import softplus_inverse
from ssplat_jax.core.pytree import replace
from ssplat_jax.model.hpda import (
    AnchorMaps,
    anchor_depth,
    anchor_inputs,
    expected_log_depth,
    num_inputs,
    peak_confidence,
)
from ssplat_jax.model.views import DepthDistribution, prepare_views
from tests.model.small import CONFIG, chunk, finite, history

pytestmark = pytest.mark.usefixtures("compiled_plainly")

PROBABILITY_SUM_ATOL = 1e-6  # a dozen float32 roundings
FLOAT32 = 1e-5  # absolute tolerance of values near 1
ZERO_GAMMA = -200.0  # raw value at which softplus underflows, so that gamma is 0

D = CONFIG.network.num_depths
SHAPE = (1, 2, 4)
MEAN = CONFIG.replace(depth_readout="mean")
WINDOW = CONFIG.replace(depth_readout="window")
READOUTS = {"mean": MEAN, "window": WINDOW}
CANDIDATES = jnp.linspace(jnp.log(1.0), jnp.log(6.0), D)
HUGE_LOGITS = 1e30 * jnp.eye(D)[3] * jnp.ones((*SHAPE, 1))
SINGLE = {"logits": jnp.full((*SHAPE, 1), 3.0), "log_candidates": jnp.full(1, 0.7)}  # one candidate

ANCHORS = {}  # name -> (changes to the ordinary inputs, check of the result)


def anchor_case(name: str, limit=None, **changes):
    ANCHORS[name] = (changes, limit)


def sure(k: int):
    """Logits of a matcher that is certain of candidate `k`."""
    return jnp.where(jnp.arange(D) == k, 0.0, -1e4) * jnp.ones((*SHAPE, 1))


def equals_matcher(given, matched, result):
    np.testing.assert_array_equal(result.probs, matched)


def equals_anchor(given, matched, result):
    omega = np.asarray(given["confidences"], np.float64)[..., None]
    offsets = np.asarray(CANDIDATES, np.float64) - np.log(np.asarray(given["depths"], np.float64))[..., None]
    anchor = omega * np.exp(-0.5 * (offsets / (0.1 + 0.5 * (1 - omega))) ** 2)
    np.testing.assert_allclose(result.probs, anchor / anchor.sum(-1, keepdims=True), atol=FLOAT32)


def has_depth_of(k: int, tolerance: float = 0.0):
    """Check that the depth is that of candidate `k`."""

    def limit(given, matched, result):
        wanted = np.full(SHAPE, given["log_candidates"][k])
        np.testing.assert_allclose(result.log_depths, wanted, rtol=0, atol=tolerance)

    return limit


def has_matcher_confidence(confidence):
    def limit(given, matched, result):
        wanted = confidence(3 if given["config"].additions.depth_readout == "window" else 1)
        np.testing.assert_allclose(result.matcher_confidences, wanted, rtol=1e-6)

    return limit


anchor_case("ordinary")
anchor_case("gamma 0", equals_matcher, raw_gamma=ZERO_GAMMA)
anchor_case("gamma to 0", equals_matcher, raw_gamma=-40.0)  # gamma 4e-18: below the spacing of every probability
anchor_case("gamma 1e6", equals_anchor, raw_gamma=1e6)
anchor_case("all holes", equals_matcher, depths=0.0, confidences=0.0, raw_gamma=1e6)
anchor_case("omega of history 0", equals_matcher, confidences=0.0, raw_gamma=1e6)
anchor_case("omega of history 1", equals_anchor, confidences=1.0, raw_gamma=1e6)
anchor_case("equal confidences", equals_anchor, confidences=0.5, raw_gamma=1e6)
anchor_case("omega an ulp above 1", equals_anchor, confidences=1 + 2**-23, at=5, raw_gamma=1e6)
anchor_case("history at the near end", equals_anchor, confidences=1.0, at=0, raw_gamma=1e6)
anchor_case("history at the far end", equals_anchor, confidences=1.0, at=D - 1, raw_gamma=1e6)
anchor_case("history before the near end", equals_matcher, confidences=1.0, depths=1e-30, raw_gamma=1e6)
anchor_case("history beyond the far end", equals_matcher, confidences=1.0, depths=1e30, raw_gamma=1e6)
anchor_case("matched at the near end", has_depth_of(0), logits=sure(0), raw_gamma=ZERO_GAMMA)
anchor_case("matched at the far end", has_depth_of(D - 1), logits=sure(D - 1), raw_gamma=ZERO_GAMMA)
anchor_case("matcher sure: omega 1", has_matcher_confidence(lambda width: 1.0), logits=sure(4))
anchor_case("matcher knows nothing", has_matcher_confidence(lambda width: width / D), logits=jnp.zeros((*SHAPE, D)))
anchor_case("matcher sure, history elsewhere", logits=sure(2), confidences=1.0, at=9, raw_gamma=1e6)
anchor_case("logits of 1e30", has_matcher_confidence(lambda width: 1.0), logits=HUGE_LOGITS)
anchor_case("near equals far", has_depth_of(0, FLOAT32), log_candidates=jnp.full(D, 0.7), at=2)
anchor_case("one candidate", has_depth_of(0), **SINGLE)
anchor_case("one candidate, history elsewhere", has_depth_of(0), **SINGLE, depths=5.0, confidences=1.0, raw_gamma=1e6)
anchor_case("sigma in scene units", anchor="metric", confidences=1.0, at=5, raw_gamma=1e6)


def wave(tree):
    """A loss that depends on every entry of every leaf."""
    return sum(jnp.mean(jnp.sin(3 * x.astype(jnp.float32))) for x in jax.tree.leaves(tree))


@functools.cache
def anchoring(config):
    views = jax.jit(prepare_views, static_argnums=1)(chunk(), CONFIG)

    def run(logits, raw_gamma, log_candidates, past):
        probs = jax.nn.softmax(logits)
        distribution = DepthDistribution(probs=probs, logits=logits, decoder=jnp.zeros((*SHAPE, 8)))
        here = replace(views, log_candidates=log_candidates)
        result = anchor_depth({"raw_gamma": raw_gamma}, distribution, past, here, config)
        return wave(result), (probs, result)

    return jax.jit(jax.value_and_grad(run, argnums=(0, 1, 2), has_aux=True))


def anchor_inputs_of(changes: dict, config) -> dict:
    rng = np.random.default_rng(0)
    given = {
        "logits": jnp.asarray(2 * rng.normal(size=(*SHAPE, D)), jnp.float32),
        "raw_gamma": softplus_inverse(0.1),
        "depths": np.exp(rng.uniform(0, np.log(6), SHAPE)),
        "confidences": rng.uniform(0.1, 1, SHAPE),
        "log_candidates": CANDIDATES,
    } | changes
    if "at" in given:  # halfway between candidates too
        given["depths"] = np.exp(np.interp(given.pop("at"), np.arange(D), given["log_candidates"]))
    for name in ("depths", "confidences"):
        given[name] = np.broadcast_to(given[name], SHAPE)
    return given | {"config": config.replace(anchor=given.pop("anchor", "log"))}


@pytest.mark.parametrize("readout", READOUTS)
@pytest.mark.parametrize("name", ANCHORS)
def test_hard_anchor(name, readout):
    changes, limit = ANCHORS[name]
    given = anchor_inputs_of(changes, READOUTS[readout])
    past = history(given["depths"], given["confidences"])
    inputs = (given["logits"], jnp.float32(given["raw_gamma"]), given["log_candidates"])
    (value, (matched, result)), gradients = anchoring(given["config"])(*inputs, past)
    assert finite((value, result)), "value"
    assert finite(gradients), "gradient"
    assert (np.asarray(result.probs) >= 0).all()
    np.testing.assert_allclose(np.asarray(result.probs, np.float64).sum(-1), 1.0, rtol=0, atol=PROBABILITY_SUM_ATOL)
    low, high = float(given["log_candidates"].min()), float(given["log_candidates"].max())
    assert (result.log_depths >= low - FLOAT32).all() and (result.log_depths <= high + FLOAT32).all()
    for confidences in (result.matcher_confidences, result.anchored_confidences):
        assert (confidences > 0).all() and (confidences <= 1).all()
    if limit is not None:
        limit(given, matched, result)
    if given["logits"].shape[-1] == 1:  # nothing to choose between
        np.testing.assert_array_equal(gradients[0], 0)


def test_gradient_of_gamma_equals_finite_differences():
    """Also where gamma is small, so that training can strengthen a weak anchor again."""
    given = anchor_inputs_of({}, MEAN)
    past = history(given["depths"], given["confidences"])
    program = anchoring(MEAN)
    value = lambda raw: float(program(given["logits"], jnp.float32(raw), CANDIDATES, past)[0][0])  # noqa: E731
    for raw in (-2.0, 0.0, 3.0):
        slope = (value(raw + 0.05) - value(raw - 0.05)) / 0.1
        (_, _), gradients = program(given["logits"], jnp.float32(raw), CANDIDATES, past)
        assert slope != 0
        assert float(gradients[1]) == pytest.approx(slope, rel=2e-2, abs=1e-5)


# -- The learned anchor ------------------------------------------------------------------------------------------------

LEARNED = WINDOW.replace(anchor="learned")
IMAGE = jnp.asarray(np.random.default_rng(7).uniform(size=(1, 8, 16, 3)), jnp.float32)
COLORS = np.random.default_rng(8).uniform(size=(*SHAPE, 3))
STARTS = (0.1, 1.0, 0.0)  # strength, width and shift of an untrained anchor
STRONGER = np.log1p(np.exp(2.0) * np.expm1(0.1))  # strength for a raw map of 2


@functools.cache
def learned():
    """Program of value, gradients and results for one set of raw maps, constant over the cells."""
    views = jax.jit(prepare_views, static_argnums=1)(chunk(), CONFIG)
    first = {name: getattr(views, name)[:1] for name in ("viewmats", "Ks", "valid", "unusable")}
    views = replace(views, **first, images=IMAGE, inside=views.inside[:1, :2, :4])
    untrained = AnchorMaps().init(jax.random.key(1), jnp.zeros((*SHAPE, num_inputs(LEARNED))))["params"]

    def run(logits, raw, log_candidates, past):
        decoder = jnp.zeros((*SHAPE, LEARNED.network.unet_width))
        distribution = DepthDistribution(jax.nn.softmax(logits), logits, decoder)
        params = untrained | {"out": untrained["out"] | {"bias": raw}}
        here = replace(views, log_candidates=log_candidates)
        result = anchor_depth(params, distribution, past, here, LEARNED)
        return wave(result), (distribution.probs, result, anchor_inputs(distribution, past, here, LEARNED))

    return jax.jit(jax.value_and_grad(run, argnums=(0, 1, 2), has_aux=True))


def run_learned(raw=(0.0, 0.0, 0.0), **changes):
    given = anchor_inputs_of(changes, LEARNED)
    colors = np.where(given["depths"][..., None] > 0, COLORS, 0.0)
    past = history(given["depths"], given["confidences"], colors=colors)
    return given, learned()(given["logits"], jnp.asarray(raw, jnp.float32), given["log_candidates"], past)


@pytest.mark.parametrize(
    ("raw", "meant"),
    [
        ((0.0, 0.0, 0.0), STARTS),
        ((-200.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
        ((1e6, 0.0, 0.5), (1e6, 1.0, 2 * np.tanh(0.5))),
        ((2.0, 1e6, -1e6), (STRONGER, np.exp(2.0), -2.0)),  # width and shift at their bounds
        ((2.0, -1e6, 1e6), (STRONGER, np.exp(-1.0), 2.0)),
    ],
)
def test_the_learned_anchor_is_a_gaussian_about_the_cached_depth(raw, meant):
    """In float64: strength, width in steps, and shift in steps as the raw maps say, within their bounds."""
    given, ((value, (matched, result, _)), gradients) = run_learned(raw)
    strength, width, shift = meant
    places = np.interp(np.log(given["depths"]), np.asarray(CANDIDATES, np.float64), np.arange(D))
    anchor = strength * np.exp(-0.5 * ((np.arange(D) - places[..., None] - shift) / width) ** 2)
    wanted = (np.asarray(matched, np.float64) + anchor) / (1 + anchor.sum(-1, keepdims=True))
    np.testing.assert_allclose(result.probs, wanted, atol=FLOAT32)
    assert finite((value, result, gradients))


HARD_LEARNED = {
    "all holes": {"depths": 0.0, "confidences": 0.0},
    "before the near end": {"depths": 1e-30},
    "beyond the far end": {"depths": 1e30},
    "logits of 1e30": {"logits": HUGE_LOGITS},
    "near equals far": {"log_candidates": jnp.full(D, 0.7), "at": 2},
    "one candidate": SINGLE | {"depths": 5.0},
}


@pytest.mark.parametrize("name", HARD_LEARNED)
def test_hard_learned_anchor(name):
    _, ((value, (matched, result, inputs)), gradients) = run_learned((1e6, 0.0, 0.0), **HARD_LEARNED[name])
    assert finite((value, result, inputs, gradients))
    np.testing.assert_allclose(np.asarray(result.probs, np.float64).sum(-1), 1.0, rtol=0, atol=PROBABILITY_SUM_ATOL)
    if name in ("all holes", "before the near end", "beyond the far end"):
        np.testing.assert_array_equal(result.probs, matched)
    if name == "all holes":  # they say nothing
        assert not np.asarray(inputs.features)[..., -(2 * 6 + 1 + 8) :].any()


def test_the_learned_anchor_reads_matcher_and_cache_about_their_depths():
    """The features in float64, cell by cell; colors are compared after their mean difference is taken out."""
    given, ((_, (matched, _, inputs)), _) = run_learned()
    probs, candidates = np.asarray(matched, np.float64), np.asarray(CANDIDATES, np.float64)
    logs = np.log(np.maximum(probs, 1e-5)) / 4 + 1
    colors = np.asarray(IMAGE, np.float64).reshape(1, 2, 4, 4, 4, 3).mean(axis=(2, 4))
    apart = colors - COLORS
    apart -= apart.mean(axis=(1, 2))
    unanchored = expected_log_depth(matched, CANDIDATES, LEARNED)
    for v, i, j in np.ndindex(SHAPE):
        around = []
        for log_depth in (float(unanchored[v, i, j]), np.log(given["depths"][v, i, j])):
            place = np.interp(log_depth, candidates, np.arange(D))
            around.append((place, np.interp(place + np.arange(-6, 7), np.arange(D), logs[v, i, j])))
        (own, of_own), (cached, of_cached) = around
        sure = max(probs[v, i, j, max(0, k - 1) : k + 2].sum() for k in range(D))
        of_matcher = [*of_own, *np.zeros(LEARNED.network.unet_width), *(4 * (colors[v, i, j] - 0.5)), sure, own / D]
        offsets = [np.tanh((own - cached) / 2), np.tanh((own - cached) / 8)]
        of_cache = [*of_cached, *offsets, given["confidences"][v, i, j], 1.0, *(8 * apart[v, i, j]), cached / D]
        np.testing.assert_allclose(inputs.features[v, i, j], [*of_matcher, *of_cache], atol=1e-4)


@pytest.mark.parametrize("readout", READOUTS)
def test_hpda_is_on_in_causal_streams_alone_unless_a_field_says_so(readout):
    given = anchor_inputs_of({}, READOUTS[readout])
    past = history(given["depths"], given["confidences"])
    inputs = (given["logits"], jnp.float32(given["raw_gamma"]), CANDIDATES, past)
    on, off, asked, causal = (
        anchoring(given["config"].replace(hpda=hpda, causal=is_causal))(*inputs)[0][1][1].probs
        for hpda, is_causal in ((True, False), (False, True), ("causal", False), ("causal", True))
    )
    np.testing.assert_array_equal(asked, off)
    np.testing.assert_array_equal(causal, on)
    assert not np.array_equal(on, off)


@pytest.mark.parametrize(("readout", "half_width"), [("metric", 0), ("mean", 0), ("window", 1)])
def test_confidence_is_the_peak_or_the_largest_mass_of_neighbors(readout, half_width):
    probs = np.random.default_rng(3).dirichlet(np.ones(D), SHAPE)
    sums = [probs[..., max(0, i - half_width) : i + half_width + 1].sum(-1) for i in range(D)]
    got = peak_confidence(jnp.asarray(probs, jnp.float32), CONFIG.replace(depth_readout=readout))
    np.testing.assert_allclose(got, np.max(sums, axis=0), atol=FLOAT32)


def test_window_readout_does_not_mix_two_surfaces():
    probs = jnp.zeros((1, D)).at[0, 2].set(0.55).at[0, 9].set(0.45)
    window, mean = (expected_log_depth(probs, CANDIDATES, config) for config in (WINDOW, MEAN))
    np.testing.assert_allclose(window, CANDIDATES[2], atol=FLOAT32)
    np.testing.assert_allclose(mean, 0.55 * CANDIDATES[2] + 0.45 * CANDIDATES[9], atol=FLOAT32)
