"""The scene memory where it could break: named hard cases of every stage between the matcher and the cache.

Each must give finite values and finite gradients, distributions that are not negative and sum to 1, and, where a limit
exists, the limit. The same for chunks that are hard as a whole is in tests/model/test_predict.py, for the numbers in
the cache's way (NaN, out of range, no room) in tests/cache, for captures far from their origin in test_world_frame.py.

    HPDA        the anchor alone: a program per configuration, small
    features    matcher to Gaussians, on bfloat16 features: one program for all cases
    cache       fuse, project, carve, judge: constants for differentiation, so values only
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax import model as stages
from ssplat_jax.cache import PIVOT_FIELDS, Tokens, VoxelCache, bear_witness, carve, init_cache, judge, project
from ssplat_jax.geometry.cameras import Camera
from ssplat_jax.model import compact
from ssplat_jax.model.compact.sweep_matching import plane_sweep
from ssplat_jax.model.types import DepthBelief, Features, Views, prepare_views
from ssplat_jax.numerics import softplus_inverse
from ssplat_jax.pytree import replace
from tests.cache import streams
from tests.cache.test_project_oracle import front_camera, with_pivots
from tests.geometry.test_rotations import rodrigues
from tests.model.small import CONFIG, chunk, finite, history, params, random_params

SUMS = 1e-6  # of probabilities: issue 3's, a dozen float32 roundings
FLOAT32 = 1e-5
OFF = -200.0  # softplus underflows: gamma is 0
D = CONFIG.network.num_depths


@pytest.fixture(autouse=True)
def _compiled_plainly(compiled_plainly):
    pass


def check_distribution(probs) -> None:
    assert (np.asarray(probs) >= 0).all()
    np.testing.assert_allclose(np.asarray(probs, np.float64).sum(-1), 1.0, rtol=0, atol=SUMS)


def check_depths(depth, log_candidates) -> None:
    """What is read from distributions over candidates."""
    check_distribution(depth.probs)
    low, high = float(log_candidates.min()), float(log_candidates.max())
    assert (depth.log_depths >= low - FLOAT32).all() and (depth.log_depths <= high + FLOAT32).all()
    for confidences in (depth.matcher_confidences, depth.anchored_confidences):
        assert (confidences > 0).all() and (confidences <= 1).all()


def wave(tree):
    """A loss that every entry of every leaf has a say in."""
    return sum(jnp.mean(jnp.sin(3 * x.astype(jnp.float32))) for x in jax.tree.leaves(tree))


# HPDA ----------------------------------------------------------------------------------------------------------------

SHAPE = (1, 2, 4)
MEAN = CONFIG.replace(depth_readout="mean", confidence="peak")
WINDOW = CONFIG.replace(depth_readout="window", confidence="window")
READOUTS = {"mean": MEAN, "window": WINDOW}
NARROW = 1e-2  # a sigma far below the candidates' distance, 0.16
CANDIDATES = jnp.linspace(jnp.log(1.0), jnp.log(6.0), D)

ANCHORS = {}  # name -> (changes to the ordinary inputs, what the result must be)


def anchor_case(name: str, limit=None, **changes):
    ANCHORS[name] = (changes, limit)


def sure(k: int):
    """Logits of a matcher that is sure of candidate `k`."""
    return jnp.where(jnp.arange(D) == k, 0.0, -1e4) * jnp.ones((*SHAPE, 1))


def is_the_matchers(given, matched, result):
    np.testing.assert_array_equal(result.probs, matched)


def is_the_anchor(given, matched, result):
    omega = np.asarray(given["confidences"], np.float64)[..., None]
    offsets = np.asarray(CANDIDATES, np.float64) - np.log(np.asarray(given["depths"], np.float64))[..., None]
    anchor = omega * np.exp(-0.5 * (offsets / (CONFIG.history.sigma0 + CONFIG.history.lambda_sigma * (1 - omega))) ** 2)
    np.testing.assert_allclose(result.probs, anchor / anchor.sum(-1, keepdims=True), atol=FLOAT32)


def reads(k: int, tolerance: float = 0.0):
    """The depth of candidate `k`."""

    def limit(given, matched, result):
        wanted = np.full(SHAPE, given["log_candidates"][k])
        np.testing.assert_allclose(result.log_depths, wanted, rtol=0, atol=tolerance)

    return limit


def matcher_is(confidence):
    def limit(given, matched, result):
        wanted = confidence(1 if given["config"].confidence == "peak" else 3)
        np.testing.assert_allclose(result.matcher_confidences, wanted, rtol=1e-6)

    return limit


anchor_case("ordinary")
anchor_case("gamma 0", is_the_matchers, raw_gamma=OFF)
anchor_case("gamma to 0", is_the_matchers, raw_gamma=-40.0)  # gamma 4e-18: below the step of every probability
anchor_case("gamma 1e6", is_the_anchor, raw_gamma=1e6)
anchor_case("all holes", is_the_matchers, depths=0.0, confidences=0.0, raw_gamma=1e6)
anchor_case("omega of history 0", is_the_matchers, confidences=0.0, raw_gamma=1e6)
anchor_case("omega of history 1", is_the_anchor, confidences=1.0, raw_gamma=1e6)
anchor_case("equal confidences", is_the_anchor, confidences=0.5, raw_gamma=1e6)
anchor_case("sigma to 0, on a candidate", reads(5, 1e-4), sigma0=1e-30, confidences=1.0, at=5, raw_gamma=1e6)
anchor_case("sigma to 0, beside them", is_the_matchers, sigma0=1e-30, confidences=1.0, at=5.4, raw_gamma=1e6)
# The two roundings cancel: without a floor sigma would be 0.
anchor_case("omega an ulp above 1", reads(5, 1e-4), sigma0=2**-24, confidences=1 + 2**-23, at=5, raw_gamma=1e6)
anchor_case("history at the near end", reads(0, FLOAT32), sigma0=NARROW, confidences=1.0, at=0, raw_gamma=1e6)
anchor_case("history at the far end", reads(D - 1, FLOAT32), sigma0=NARROW, confidences=1.0, at=D - 1, raw_gamma=1e6)
anchor_case("history before the near end", is_the_matchers, sigma0=NARROW, confidences=1.0, depths=1e-30, raw_gamma=1e6)
anchor_case("history beyond the far end", is_the_matchers, sigma0=NARROW, confidences=1.0, depths=1e30, raw_gamma=1e6)
anchor_case("matched at the near end", reads(0), logits=sure(0), raw_gamma=OFF)
anchor_case("matched at the far end", reads(D - 1), logits=sure(D - 1), raw_gamma=OFF)
anchor_case("matcher sure: omega 1", matcher_is(lambda width: 1.0), logits=sure(4))
anchor_case("matcher knows nothing", matcher_is(lambda width: width / D), logits=jnp.zeros((*SHAPE, D)))
anchor_case("matcher sure, history elsewhere", logits=sure(2), confidences=1.0, at=9, sigma0=NARROW, raw_gamma=1e6)
anchor_case("logits of 1e30", matcher_is(lambda width: 1.0), logits=1e30 * jnp.eye(D)[3] * jnp.ones((*SHAPE, 1)))
anchor_case("near equals far", reads(0, FLOAT32), log_candidates=jnp.full(D, 0.7), at=2)
anchor_case("one candidate", reads(0), logits=jnp.full((*SHAPE, 1), 3.0), log_candidates=jnp.full(1, 0.7))
anchor_case(
    "one candidate, history elsewhere",
    reads(0),
    logits=jnp.full((*SHAPE, 1), 3.0),
    log_candidates=jnp.full(1, 0.7),
    depths=5.0,
    confidences=1.0,
    raw_gamma=1e6,
)
anchor_case("sigma in scene units", anchor_space="metric", sigma0=1e-30, confidences=1.0, at=5, raw_gamma=1e6)
anchor_case("anchor of mass 0", is_the_matchers, anchor_norm="mass", sigma0=NARROW, depths=1e30, raw_gamma=1e6)


@functools.cache
def anchoring(config):
    views = prepare_views(chunk(), CONFIG)

    def run(logits, raw_gamma, log_candidates, past):
        probs = jax.nn.softmax(logits)
        belief = DepthBelief(probs=probs, logits=logits, decoder=jnp.zeros((*SHAPE, 8)))
        here = replace(views, log_candidates=log_candidates)
        result = stages.anchor_depth({"raw_gamma": raw_gamma}, belief, past, here, config)
        return wave(result), (probs, result)

    return jax.jit(jax.value_and_grad(run, argnums=(0, 1, 2), has_aux=True))


def anchor_inputs(changes: dict, config) -> dict:
    rng = np.random.default_rng(0)
    given = {
        "logits": jnp.asarray(2 * rng.normal(size=(*SHAPE, D)), jnp.float32),
        "raw_gamma": softplus_inverse(0.1),
        "depths": np.exp(rng.uniform(0, np.log(6), SHAPE)),
        "confidences": rng.uniform(0.1, 1, SHAPE),
        "log_candidates": CANDIDATES,
    } | changes
    options = {name: given.pop(name) for name in ("sigma0", "anchor_space", "anchor_norm") if name in given}
    if "at" in given:  # halfway between candidates too
        given["depths"] = np.exp(np.interp(given.pop("at"), np.arange(D), given["log_candidates"]))
    for name in ("depths", "confidences"):
        given[name] = np.broadcast_to(given[name], SHAPE)
    return given | {"config": config.replace(**options)}


@pytest.mark.parametrize("readout", READOUTS)
@pytest.mark.parametrize("name", ANCHORS)
def test_hard_anchor(name, readout):
    changes, limit = ANCHORS[name]
    given = anchor_inputs(changes, READOUTS[readout])
    past = history(given["depths"], given["confidences"])
    inputs = (given["logits"], jnp.float32(given["raw_gamma"]), given["log_candidates"])
    (value, (matched, result)), gradients = anchoring(given["config"])(*inputs, past)
    assert finite((value, result)), "value"
    assert finite(gradients), "gradient"
    check_depths(result, given["log_candidates"])
    if limit is not None:
        limit(given, matched, result)
    if given["logits"].shape[-1] == 1:  # nothing to choose between
        np.testing.assert_array_equal(gradients[0], 0)


def test_sigma_to_zero_in_scene_units_is_one_candidate_too():
    changes, _ = ANCHORS["sigma in scene units"]
    given = anchor_inputs(changes, MEAN)
    on_candidate = jnp.full(SHAPE, jnp.exp(CANDIDATES)[5])
    inputs = (given["logits"], jnp.float32(given["raw_gamma"]), CANDIDATES, history(on_candidate, given["confidences"]))
    (_, (_, result)), _ = anchoring(given["config"])(*inputs)
    assert (result.probs[..., 5] > 1 - 1e-4).all()


def test_9_the_gradient_of_gamma_is_that_of_finite_differences():
    """Invariant 9; at gamma = 0 too, from where an anchor must be able to come back."""
    given = anchor_inputs({}, MEAN)
    past = history(given["depths"], given["confidences"])
    program = anchoring(MEAN)
    value = lambda raw: float(program(given["logits"], jnp.float32(raw), CANDIDATES, past)[0][0])  # noqa: E731
    for raw in (-2.0, 0.0, 3.0):
        slope = (value(raw + 0.05) - value(raw - 0.05)) / 0.1
        (_, _), gradients = program(given["logits"], jnp.float32(raw), CANDIDATES, past)
        assert slope != 0
        assert float(gradients[1]) == pytest.approx(slope, rel=2e-2, abs=1e-5)


# Features ------------------------------------------------------------------------------------------------------------

GRID = (3, 8, 8)
HALF = jnp.bfloat16


def ordinary() -> dict:
    """Inputs of the stages behind the encoder: bfloat16 features, a history over two thirds of the cells."""
    rng = np.random.default_rng(1)
    width = CONFIG.network.encoder_widths[1]
    normal = lambda *shape: jnp.asarray(rng.normal(size=shape), HALF)  # noqa: E731
    known = rng.uniform(size=GRID) < 2 / 3
    past = history(
        np.where(known, np.exp(rng.uniform(0, np.log(6), GRID)), 0), np.where(known, rng.uniform(0.1, 1, GRID), 0)
    )
    return {
        "params": params(),
        "features": Features(
            fine=normal(3, 16, 16, CONFIG.network.match_width),
            grid=normal(*GRID, CONFIG.network.match_width),
            context=normal(*GRID, 2 * width),
        ),
        "past": replace(past, feats=normal(*GRID, CONFIG.network.token_width) * known[..., None].astype(HALF)),
        "views": prepare_views(chunk(), CONFIG),
    }


@functools.cache
def tokens_and_gaussians():
    """Everything behind the encoder, with gradients by parameters, features and cameras."""

    def run(params, features, viewmats, views: Views, past):
        views = replace(views, viewmats=viewmats)
        belief = compact.match(params["cost_volume"], features, views, CONFIG)
        depth = stages.anchor_depth(params["hpda"], belief, past, views, CONFIG)
        positions, footprints = stages.back_project(depth.log_depths, views)
        regressed = compact.regress_tokens(params["tokens"], features, belief, depth, views, CONFIG)
        injected = stages.inject_features(params["cgfi"], regressed, past, depth.anchored_confidences, views, CONFIG)
        mixed = compact.mix_tokens(params["mixer"], injected, positions, views.inside, views.valid, CONFIG)
        gaussians = stages.decode_tokens(
            compact.read_shapes(params["decoder"], mixed.reshape(-1, CONFIG.network.token_width).astype(HALF), CONFIG),
            means=positions.reshape(-1, 3),
            rgbs=stages.patch_colors(views.images, CONFIG).reshape(footprints.size, -1),
            quats=jnp.ones((footprints.size, 4)),
            footprints=footprints.reshape(-1),
            config=CONFIG,
        )
        return wave((depth, injected, mixed, gaussians)), (belief, depth, injected, mixed, gaussians)

    return jax.jit(jax.value_and_grad(run, argnums=(0, 1, 2), has_aux=True))


@functools.cache
def sweep():
    single = lambda features: jax.tree.map(lambda x: x.astype(jnp.float32), features)  # noqa: E731
    return jax.jit(lambda features, views: plane_sweep(single(features), views, CONFIG))


def run_stages(given: dict):
    """`(value, results), gradients` of all stages."""
    views = given["views"]
    return tokens_and_gaussians()(given["params"], given["features"], views.viewmats, views, given["past"])


def costs(given: dict):
    """Mean cosines, `[view, row, column, level, candidate]`."""
    return np.asarray(sweep()(given["features"], given["views"])).reshape(*GRID, 2, D)


STAGES = {}


def stage_case(name: str):
    def register(function):
        STAGES[name] = function
        return function

    return register


def turned(angle: float):
    viewmats = np.tile(np.eye(4), (3, 1, 1))
    for i, matrix in enumerate(viewmats):
        matrix[:3, :3] = rodrigues([0, 1, 0], angle * i)
    return jnp.asarray(viewmats, jnp.float32)


def with_views(given: dict, **changes) -> dict:
    return given | {"views": prepare_views(replace(chunk(), **changes), CONFIG)}


def with_weights(given: dict, stage: str, **changes) -> dict:
    return given | {"params": given["params"] | {stage: given["params"][stage] | changes}}


# A case returns its inputs and what must hold of (belief, depth, injected, mixed, gaussians).
@stage_case("ordinary")
def _(given):
    return given, None


@stage_case("zero features")
def _(given):
    given["features"] = jax.tree.map(jnp.zeros_like, given["features"])
    return given, lambda *_: np.testing.assert_array_equal(costs(given), 0)


@stage_case("identical features")
def _(given):
    given["features"] = jax.tree.map(jnp.ones_like, given["features"])

    def limit(*_):
        cost = costs(given)
        assert (np.minimum(np.abs(cost), np.abs(cost - 1)) < FLOAT32).all()  # 0 where no source sees the candidate
        assert (cost > 0.5).mean() > 0.2

    return given, limit


@stage_case("features of 1e20")
def _(given):
    before = costs(given)
    features = given["features"]
    given["features"] = replace(features, fine=features.fine * HALF(1e20), grid=features.grid * HALF(1e20))
    return given, lambda *_: np.testing.assert_allclose(costs(given), before, atol=0.02)  # cosines of rounded products


def check_flat(cost):
    """No candidate is better than another where both are seen."""
    assert np.ptp(cost, axis=-1).max() < 1e-4
    assert np.abs(cost).max() > 0.1


@stage_case("zero baseline")
def _(given):
    given = with_views(given, viewmats=jnp.broadcast_to(jnp.eye(4), (3, 4, 4)))
    return given, lambda *_: check_flat(costs(given))


@stage_case("pure rotation")
def _(given):
    given = with_views(given, viewmats=turned(0.2))
    return given, lambda *_: check_flat(costs(given))


@stage_case("cameras back to back")
def _(given):
    given = with_views(given, viewmats=turned(np.pi))
    return given, lambda *_: np.testing.assert_array_equal(costs(given)[1], 0)  # between two that look the other way


@stage_case("one view")
def _(given):
    given = with_views(given, valid=jnp.array([True, False, False]))
    return given, lambda *_: np.testing.assert_array_equal(costs(given)[0], 0)


@stage_case("all views masked")
def _(given):
    given = with_views(given, valid=jnp.zeros(3, bool))
    return given, lambda *_: np.testing.assert_array_equal(costs(given), 0)


@stage_case("near equals far")
def _(given):
    given = with_views(given, far=jnp.float32(1.0))
    return given, lambda belief, depth, *_: np.testing.assert_allclose(depth.log_depths, 0, atol=FLOAT32)


@stage_case("gamma 0")
def _(given):
    given = with_weights(given, "hpda", raw_gamma=jnp.float32(OFF))
    return given, lambda belief, depth, *_: np.testing.assert_array_equal(depth.probs, belief.probs)


@stage_case("gamma 1e6")
def _(given):
    given = with_weights(given, "hpda", raw_gamma=jnp.float32(1e6))

    def limit(belief, depth, *_):
        hole = ~np.asarray(given["past"].mask)
        np.testing.assert_array_equal(np.asarray(depth.probs)[hole], np.asarray(belief.probs)[hole])
        assert np.abs(np.asarray(depth.probs - belief.probs))[~hole].max(-1).min() > 1e-3

    return given, limit


def surely(given: dict, k: int) -> dict:
    """The matcher is sure of candidate `k` everywhere, and history does not speak against it."""
    head = given["params"]["cost_volume"]["head2"]
    given = with_weights(given, "cost_volume", head2=head | {"bias": 1e5 * jnp.eye(D)[k]})
    return with_weights(given, "hpda", raw_gamma=jnp.float32(OFF))


@stage_case("omega 1: CGFI hears no history")
def _(given):
    given = surely(given, 4)
    other = given | {"past": replace(given["past"], feats=-given["past"].feats)}

    def limit(belief, depth, injected, mixed, gaussians):
        np.testing.assert_array_equal(depth.anchored_confidences, 1)
        np.testing.assert_array_equal(run_stages(other)[0][1][2], injected)

    return given, limit


@pytest.mark.slow
@pytest.mark.parametrize("k", [0, D - 1])
def test_matched_at_an_end_of_the_candidates(k):
    given = surely(ordinary(), k)
    (_, (_, depth, *_)), gradients = run_stages(given)
    assert finite(gradients)
    wanted = np.full(GRID, given["views"].log_candidates[k])
    np.testing.assert_array_equal(depth.log_depths, wanted)


@stage_case("omega of history 0")
def _(given):
    given["past"] = replace(given["past"], confidences=jnp.zeros(GRID))
    return given, lambda belief, depth, *_: np.testing.assert_array_equal(depth.probs, belief.probs)


@stage_case("history of zero features")
def _(given):
    given["past"] = replace(given["past"], feats=jnp.zeros_like(given["past"].feats))
    return given, None


@stage_case("history of identical features")
def _(given):
    given["past"] = replace(given["past"], feats=jnp.ones_like(given["past"].feats))
    return given, None


@stage_case("all holes")
def _(given):
    nothing = history(np.zeros(GRID), np.zeros(GRID))
    given["past"] = replace(nothing, feats=nothing.feats.astype(HALF))
    return given, lambda belief, depth, *_: np.testing.assert_array_equal(depth.probs, belief.probs)


@pytest.mark.parametrize("name", STAGES)
def test_hard_features(name):
    given, limit = STAGES[name](ordinary())
    (value, results), gradients = run_stages(given)
    assert finite((value, results)), "value"
    assert finite(gradients), "gradient"
    belief, depth, _, mixed, gaussians = results
    assert {x.dtype for x in jax.tree.leaves(results)} == {jnp.dtype(jnp.float32)}
    check_distribution(belief.probs)
    check_depths(depth, given["views"].log_candidates)
    assert (np.asarray(mixed, np.float64) ** 2).mean(-1).max() <= 1 + FLOAT32
    assert ((gaussians.opacities >= 0) & (gaussians.opacities <= 1)).all() and (gaussians.scales > 0).all()
    if limit is not None:
        limit(*results)


@pytest.mark.slow
def test_one_candidate_is_certain():
    """D = 1 through the matcher; what is read from it is among the anchor's cases."""
    config = CONFIG.replace(num_depths=1, fine_matching=False)
    given = ordinary()
    views = prepare_views(chunk(), config)
    np.testing.assert_array_equal(views.log_candidates, np.log(chunk().near))

    def total(weights, features):
        belief = compact.match(weights, features, views, config)
        return wave(belief), belief

    weights = random_params(config)["cost_volume"]
    (_, belief), gradients = jax.jit(jax.value_and_grad(total, argnums=(0, 1), has_aux=True))(
        weights, given["features"]
    )
    assert finite(gradients)
    np.testing.assert_array_equal(belief.probs, 1)


# Cache ---------------------------------------------------------------------------------------------------------------

CACHE = streams.CONFIG.replace(pivots_per_voxel=2)  # a third token in a voxel merges
ANY = CACHE.replace(min_confidence=0.0)


def offered(means, confidences=0.5, feats=1.0, valid=True, **changes) -> Tokens:
    """Tokens at `means`; their colors number them."""
    n = len(means)
    full = lambda x, *shape: jnp.broadcast_to(jnp.asarray(x, jnp.float32), (n, *shape))  # noqa: E731
    tokens = Tokens(
        means=jnp.asarray(means, jnp.float32),
        feats=full(feats, streams.WIDTH),
        confidences=full(confidences),
        rgbs=jnp.arange(n, dtype=jnp.float32)[:, None] * jnp.ones(3 * CONFIG.head.gaussians_per_token),
        quats=full([1.0, 0, 0, 0], 4),
        footprints=full(0.1),
        valid=jnp.broadcast_to(jnp.asarray(valid), (n,)),
    )
    return replace(tokens, **changes)


def empty() -> VoxelCache:
    return init_cache(CACHE, streams.CAPACITY)


def fused(tokens, config=CACHE, cache=None) -> VoxelCache:
    """`cache` after `tokens`, which is checked to be finite and within its bounds."""
    cache, _ = streams.fuse(empty() if cache is None else jax.tree.map(jnp.copy, cache), tokens, config)
    assert finite(cache)
    alive = np.asarray(cache.alive)
    confidences = np.asarray(cache.confidences)
    assert ((confidences >= 0) & (confidences <= 1)).all() and not confidences[~alive].any()
    return cache


IN_A_VOXEL = [[0.11, 0.10, 0.10], [0.12, 0.10, 0.10], [0.17, 0.10, 0.10]]


def assert_same(a: VoxelCache, b: VoxelCache) -> None:
    for name in ("voxels", "counts", "num_voxels", "table", *PIVOT_FIELDS):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), name)


def test_omega_0_leaves_the_cache_untouched():
    before = fused(offered(IN_A_VOXEL))
    after = fused(offered(IN_A_VOXEL, confidences=0.0), cache=before)
    assert_same(before, after)
    assert int(after.stats.num_low_confidence) == 3


def test_all_views_masked_leave_the_cache_untouched():
    before = fused(offered(IN_A_VOXEL))
    after = fused(offered(IN_A_VOXEL, valid=False), cache=before)
    jax.tree.map(np.testing.assert_array_equal, before, after)


def test_omega_0_where_it_is_let_in_is_averaged_evenly_and_seen_by_nobody():
    cache = fused(offered(IN_A_VOXEL, confidences=0.0), ANY)
    np.testing.assert_allclose(cache.means[0, 0], np.mean(IN_A_VOXEL[:2], axis=0), atol=1e-7)
    camera = replace(front_camera(), viewmats=jnp.eye(4).at[2, 3].set(2.0)[None])
    assert not any(np.any(np.asarray(x)) for x in jax.tree.leaves(project(cache, camera, ANY)))


def test_omega_1_beside_omega_0_decides_alone():
    cache = fused(offered(IN_A_VOXEL, confidences=jnp.array([1.0, 0.0, 0.5])), ANY)
    np.testing.assert_array_equal(cache.means[0, 0], np.float32(IN_A_VOXEL[0]))
    assert cache.confidences[0, 0] == 1


@pytest.mark.parametrize("feats", [0.0, 1.0, 1e-30, 1e30], ids=["zero", "identical", "1e-30", "1e30"])
def test_features_without_a_closest_pair_merge_the_first_two(feats):
    """Zero features, and norms whose squares leave float32, count as orthogonal; identical ones are all ties."""
    cache = fused(offered(IN_A_VOXEL, feats=feats))
    assert int(cache.stats.num_merged) == 1
    np.testing.assert_allclose(cache.means[0, 0], np.mean(IN_A_VOXEL[:2], axis=0), atol=1e-7)
    np.testing.assert_array_equal(cache.means[0, 1], np.float32(IN_A_VOXEL[2]))
    np.testing.assert_allclose(cache.feats[0], np.full((2, streams.WIDTH), feats), rtol=1e-6)


def test_equal_confidences_keep_the_older_members_seed_and_take_the_midpoint():
    feats = jnp.array([[1.0, 0, 0, 0], [1.0, 0.1, 0, 0], [0, 0, 1.0, 0]])
    cache = fused(replace(offered(IN_A_VOXEL, confidences=0.7), feats=feats))
    np.testing.assert_array_equal(cache.seeds[0, 0], feats[0])
    np.testing.assert_allclose(cache.feats[0, 0], (feats[0] + feats[1]) / 2, atol=1e-7)
    np.testing.assert_allclose(cache.rgbs[0, 0], 0.5, atol=1e-7)
    assert cache.confidences[0, 0] == np.float32(0.7)


def test_hundreds_of_tokens_at_one_point_stay_there():
    tokens = streams.Recipe(seed=1, places="one_voxel", features="normal", confidences="random").tokens()
    tokens["means"][:] = IN_A_VOXEL[0]
    cache = empty()
    for _ in range(8):
        cache = fused(streams.to_jax(tokens), CACHE, cache)
    np.testing.assert_array_equal(cache.means[0], np.tile(np.float32(IN_A_VOXEL[0]), (2, 1)))
    assert int(cache.num_voxels) == 1 and int(cache.stats.num_merged) > 100


def test_a_cache_of_bfloat16_features_is_the_float32_one_rounded():
    """Places, choices and weights are float32 in both; only features are stored more coarsely."""
    tokens = streams.to_jax(streams.Recipe(seed=3, places="few", features="normal", confidences="random").tokens())
    tokens = replace(tokens, feats=tokens.feats.astype(HALF).astype(jnp.float32))
    single = fused(tokens)
    blank = empty()
    half = fused(tokens, cache=replace(blank, feats=blank.feats.astype(HALF), seeds=blank.seeds.astype(HALF)))
    assert half.feats.dtype == half.seeds.dtype == HALF and int(single.stats.num_merged) > 0
    for name in ("counts", "voxels", "confidences", "num_members", "footprints"):
        np.testing.assert_array_equal(getattr(half, name), getattr(single, name), name)
    np.testing.assert_allclose(half.means, single.means, atol=1e-7)
    np.testing.assert_allclose(half.feats.astype(jnp.float32), single.feats, atol=0.02)
    camera = replace(front_camera(), viewmats=jnp.eye(4).at[2, 3].set(2.0)[None])
    a, b = (project(cache, camera, CACHE) for cache in (half, single))
    assert a.feats.dtype == jnp.float32 and a.mask.any()
    np.testing.assert_array_equal(a.depths, b.depths)
    np.testing.assert_allclose(a.feats, b.feats, atol=0.02)


# A pivot on the axis of the front camera, and the depth and confidence that are read at its pixel.
SEEN = {
    "omega 1": ([[0, 0, 2.0]], [1.0], (2.0, 1.0)),
    "omega to 0": ([[0, 0, 2.0]], [1e-10], (2.0, 1e-10)),
    "omega whose square underflows": ([[0, 0, 2.0]], [1e-37], (2.0, 0.0)),
    "equal confidences": ([[0, 0, 2.0], [0, 0, 2.1]], [0.5, 0.5], (np.sqrt(2.0 * 2.1), 0.5)),
    "omega 0 before omega 1": ([[0, 0, 1.0], [0, 0, 2.0]], [0.0, 1.0], (2.0, 1.0)),
    "at one point": ([[0, 0, 2.0]] * 16, np.linspace(0.1, 1, 16), None),
    "at the camera": ([[0, 0, 0.0], [0, 0, 2.0]], [1.0, 0.5], (2.0, 0.5)),
    "just before the near plane": ([[0, 0, 0.0101]], [0.5], (0.0101, 0.5)),
    "very far": ([[0, 0, 1e30]], [0.5], (1e30, 0.5)),
    "beside the camera": ([[1e-3, 0, 1e-30], [0, 0, 2.0]], [0.5, 0.5], (2.0, 0.5)),
}


@functools.cache
def reading():
    # Without carving pivots of any confidence are seen, down to those whose square underflows.
    return jax.jit(functools.partial(project, config=CACHE.replace(carving=False)))


@pytest.mark.parametrize("name", SEEN)
def test_hard_projection(name):
    means, confidences, wanted = SEEN[name]
    seen = reading()(with_pivots(means, confidences), front_camera())
    assert finite(seen)
    assert (seen.confidences >= 0).all() and (seen.confidences <= 1 + SUMS).all()
    if wanted is not None:
        assert np.argwhere(np.asarray(seen.mask)).tolist() == [[0, 3, 4]]
        np.testing.assert_allclose((seen.depths[0, 3, 4], seen.confidences[0, 3, 4]), wanted, rtol=1e-4)


def test_what_was_carved_away_hides_nothing_from_the_projection():
    cache = with_pivots([[0.0, 0.0, 1.0], [0.0, 0.0, 2.0]], [0.02, 0.9])
    carved = project(cache, front_camera(), CACHE.replace(carving=True))
    kept = project(cache, front_camera(), CACHE.replace(carving=False))
    depths = [float(np.max(np.asarray(seen.depths))) for seen in (carved, kept)]
    np.testing.assert_allclose(depths, [2.0, 1.0], rtol=1e-5)
    np.testing.assert_allclose(np.max(np.asarray(carved.confidences)), 0.9, rtol=1e-5)


def test_projection_into_cameras_at_one_place_is_the_same_in_each():
    """Zero baseline; and into no camera's sight, once all look away."""
    rng = np.random.default_rng(2)
    cache = with_pivots(rng.uniform([-0.5, -0.5, 1], [0.5, 0.5, 3], (16, 3)), rng.uniform(0.1, 1, 16))
    both = front_camera()[jnp.zeros(2, jnp.int32)]
    seen = project(cache, both, CACHE)
    assert seen.mask.any()
    jax.tree.map(lambda x: np.testing.assert_array_equal(x[0], x[1]), seen)
    away = replace(both, viewmats=both.viewmats @ jnp.diag(jnp.array([-1.0, 1, -1, 1])))
    assert not project(cache, away, CACHE).mask.any()


CELLS = (1, front_camera().height, front_camera().width)
NOT_JUDGED = None
# (confidence of a pivot at depth 1, depth seen, confidence of the witness) -> confidence after, or what it tends to
VERDICTS = {
    "omega 0 is no pivot": (0.0, 2.0, 1.0, NOT_JUDGED),
    "omega 1 looked through": (1.0, 2.0, 1.0, 0.72),  # held to 0.95, then odds / e^2
    "omega 1 seen": (1.0, 1.0, 1.0, 0.95),
    "omega to 0 seen": (1e-37, 1.0, 1.0, 0.0326),  # held to 0.02, then odds x e^0.5
    "witness of omega 0": (0.6, 2.0, 0.0, NOT_JUDGED),
    "witness at tau": (0.6, 2.0, float(np.float32(CACHE.memory.min_confidence)), 0.4515),
    "surface on the camera": (0.6, 1e-30, 1.0, NOT_JUDGED),  # the pivot is hidden behind it
    "surface at infinity": (0.6, np.inf, 1.0, NOT_JUDGED),
    "surface at 1e30": (0.6, 1e30, 1.0, 0.1687),
    "all views masked": (0.6, 2.0, 0.0, NOT_JUDGED),
}


@functools.cache
def verdict_programs():
    return (
        jax.jit(functools.partial(carve, config=CACHE)),
        jax.jit(functools.partial(judge, config=CACHE)),
        jax.jit(functools.partial(bear_witness, config=CACHE)),
    )


@pytest.mark.parametrize("name", VERDICTS)
def test_hard_verdict_on_pivots_and_on_tokens(name):
    confidence, depth, weight, wanted = VERDICTS[name]
    carving, judging, bearing = verdict_programs()
    seen = (front_camera(), jnp.full(CELLS, depth, jnp.float32), jnp.full(CELLS, weight, jnp.float32))
    pivot = float(carving(with_pivots([[0, 0, 1.0]], [confidence]), *seen).confidences[0, 0])
    wanted = np.float32(confidence) if wanted is NOT_JUDGED else wanted
    assert pivot == pytest.approx(wanted, rel=2e-3) if wanted else pivot == 0
    witness = bearing(replace(empty(), stats=replace(empty().stats, num_chunks=jnp.int32(1))), *seen)
    token = judging(witness.witnesses, offered([[0, 0, 1.0]], confidences=confidence))
    assert finite((witness, token))
    below_tau = confidence < CACHE.memory.min_confidence
    assert float(token.confidences[0]) == pytest.approx(confidence if below_tau else wanted, rel=2e-3)


def test_a_camera_far_from_the_origin_reads_its_own_surroundings():
    """6.4e6 away float32 has a step of 0.5: nothing is right to less, but all is finite and counted as out of range."""
    far = 6.4e6
    camera = Camera(viewmats=jnp.eye(4).at[2, 3].set(-far)[None], Ks=front_camera().Ks, width=CELLS[2], height=CELLS[1])
    cache = with_pivots([[0, 0, far + 4.0]])
    seen = reading()(cache, camera)
    assert finite(seen) and seen.depths[0, 3, 4] == pytest.approx(4.0, abs=0.5)
    after = fused(offered([[0, 0, far + 4.0]]))
    assert int(after.stats.num_out_of_range) == 1 and int(after.num_voxels) == 0
