"""Hard cases of the stages from the matcher to the Gaussians, on bfloat16 features: one program for all cases.

Values and gradients must be finite, distributions nonnegative with sum 1, and limits reached where they exist. Chunks
that are hard as a whole are in tests/model/test_predict.py.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.core.pytree import replace
from ssplat_jax.model import compact
from ssplat_jax.model.cgfi import inject_features
from ssplat_jax.model.compact.compact_layers import CompactFeatures
from ssplat_jax.model.compact.sweep_matching import plane_sweep
from ssplat_jax.model.decoder import decode_tokens
from ssplat_jax.model.hpda import anchor_depth
from ssplat_jax.model.views import Views, back_project, patch_colors, prepare_views
from tests.core.test_rotations import rodrigues
from tests.model.small import CONFIG, chunk, finite, history, params
from tests.stability.stage_checks import FLOAT32, ZERO_GAMMA, check_depths, check_distribution, wave

pytestmark = pytest.mark.usefixtures("compiled_plainly")

D = CONFIG.network.num_depths
GRID = (3, 8, 8)
HALF = jnp.bfloat16


def ordinary() -> dict:
    """Inputs of the stages after the encoder: bfloat16 features, a history in two thirds of the cells."""
    rng = np.random.default_rng(1)
    width = CONFIG.network.encoder_widths[1]
    normal = lambda *shape: jnp.asarray(rng.normal(size=shape), HALF)  # noqa: E731
    known = rng.uniform(size=GRID) < 2 / 3
    past = history(
        np.where(known, np.exp(rng.uniform(0, np.log(6), GRID)), 0), np.where(known, rng.uniform(0.1, 1, GRID), 0)
    )
    return {
        "params": params(),
        "features": CompactFeatures(
            fine=normal(3, 16, 16, CONFIG.network.match_width),
            grid=normal(*GRID, CONFIG.network.match_width),
            context=normal(*GRID, 2 * width),
        ),
        "past": replace(past, feats=normal(*GRID, CONFIG.network.token_width) * known[..., None].astype(HALF)),
        "views": prepare_views(chunk(), CONFIG),
    }


@functools.cache
def tokens_and_gaussians():
    """All stages after the encoder, with gradients by parameters, features and cameras."""

    def run(params, features, viewmats, views: Views, past):
        views = replace(views, viewmats=viewmats)
        distribution = compact.match(params["cost_volume"], features, views, CONFIG)
        depth = anchor_depth(params["hpda"], distribution, past, views, CONFIG)
        positions, footprints = back_project(depth.log_depths, views)
        regressed = compact.regress_tokens(params["tokens"], features, distribution, depth, views, CONFIG)
        injected = inject_features(params["cgfi"], regressed, past, depth.anchored_confidences, views, CONFIG)
        mixed = compact.mix_tokens(params["mixer"], injected, positions, views.inside, views.valid, CONFIG)
        gaussians = decode_tokens(
            compact.read_shapes(params["decoder"], mixed.reshape(-1, CONFIG.network.token_width).astype(HALF), CONFIG),
            means=positions.reshape(-1, 3),
            rgbs=patch_colors(views.images, CONFIG).reshape(footprints.size, -1),
            quats=jnp.ones((footprints.size, 4)),
            footprints=footprints.reshape(-1),
            config=CONFIG,
        )
        return wave((depth, injected, mixed, gaussians)), (distribution, depth, injected, mixed, gaussians)

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


# A case returns its inputs and a check of (distribution, depth, injected, mixed, gaussians).
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
    """No candidate is better than another, and some are seen."""
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
    return given, lambda distribution, depth, *_: np.testing.assert_allclose(depth.log_depths, 0, atol=FLOAT32)


@stage_case("gamma 0")
def _(given):
    given = with_weights(given, "hpda", raw_gamma=jnp.float32(ZERO_GAMMA))
    return given, lambda distribution, depth, *_: np.testing.assert_array_equal(depth.probs, distribution.probs)


@stage_case("gamma 1e6")
def _(given):
    given = with_weights(given, "hpda", raw_gamma=jnp.float32(1e6))

    def limit(distribution, depth, *_):
        hole = ~np.asarray(given["past"].mask)
        np.testing.assert_array_equal(np.asarray(depth.probs)[hole], np.asarray(distribution.probs)[hole])
        assert np.abs(np.asarray(depth.probs - distribution.probs))[~hole].max(-1).min() > 1e-3

    return given, limit


def certain_of(given: dict, k: int) -> dict:
    """Inputs with a matcher certain of candidate `k` everywhere, and without influence of the history."""
    head = given["params"]["cost_volume"]["head2"]
    given = with_weights(given, "cost_volume", head2=head | {"bias": 1e5 * jnp.eye(D)[k]})
    return with_weights(given, "hpda", raw_gamma=jnp.float32(ZERO_GAMMA))


@stage_case("omega 1: CGFI ignores history")
def _(given):
    given = certain_of(given, 4)
    other = given | {"past": replace(given["past"], feats=-given["past"].feats)}

    def limit(distribution, depth, injected, mixed, gaussians):
        np.testing.assert_array_equal(depth.anchored_confidences, 1)
        np.testing.assert_array_equal(run_stages(other)[0][1][2], injected)

    return given, limit


@stage_case("omega of history 0")
def _(given):
    given["past"] = replace(given["past"], confidences=jnp.zeros(GRID))
    return given, lambda distribution, depth, *_: np.testing.assert_array_equal(depth.probs, distribution.probs)


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
    return given, lambda distribution, depth, *_: np.testing.assert_array_equal(depth.probs, distribution.probs)


@pytest.mark.parametrize("name", STAGES)
def test_hard_features(name):
    given, limit = STAGES[name](ordinary())
    (value, results), gradients = run_stages(given)
    assert finite((value, results)), "value"
    assert finite(gradients), "gradient"
    distribution, depth, _, mixed, gaussians = results
    assert {x.dtype for x in jax.tree.leaves(results)} == {jnp.dtype(jnp.float32)}
    check_distribution(distribution.probs)
    check_depths(depth, given["views"].log_candidates)
    assert (np.asarray(mixed, np.float64) ** 2).mean(-1).max() <= 1 + FLOAT32
    assert ((gaussians.opacities >= 0) & (gaussians.opacities <= 1)).all() and (gaussians.scales > 0).all()
    if limit is not None:
        limit(*results)
