"""Carving and judging equal the NumPy reference, and witnesses act within their limits."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from ssplat_jax.cache import carve, init_cache, judge, store_witness
from ssplat_jax.cache import numpy_reference as reference
from ssplat_jax.cache.state import WITNESS_CELLS
from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.pytree import replace
from tests.cache.projection_scenes import (
    DECISION_MARGIN,
    DEPTHS,
    GRID_WIDTH,
    HEIGHT,
    SEED,
    SETTINGS,
    cameras,
    front_camera,
    scene,
    with_pivots,
)
from tests.cache.streams import CAPACITY, CONFIG, tokens_at

jit_carve = jax.jit(carve, static_argnums=4)
jit_judge = jax.jit(judge, static_argnums=2)
jit_bear_witness = jax.jit(store_witness, static_argnums=4)
SHAPE = (1, HEIGHT, GRID_WIDTH)


def seen(depth: float, confidence: float = 0.8):
    """Depths and confidences of the front camera, the same in every cell."""
    return jnp.full(SHAPE, depth), jnp.full(SHAPE, confidence)


def random_views(seed: int, height: int = HEIGHT, width: int = GRID_WIDTH):
    """Depths and confidences of two views, some of them untrusted."""
    rng = np.random.default_rng(seed)
    shape = (2, height, width)
    depths = rng.uniform(2.5, 5.5, shape).astype(np.float32)
    depths.reshape(-1)[:3] = [np.nan, np.inf, 0.0]
    confidences = rng.choice([0.0, 0.25, 0.6, 0.7, 0.8, 0.9, 1.0], shape, p=[0.02, 0.02, *[0.192] * 5])
    return depths, confidences.astype(np.float32)


def after_chunk(cache, camera, depths, confidences, config=CONFIG):
    """The cache after a chunk was counted and its witness stored."""
    stats = replace(cache.stats, num_chunks=cache.stats.num_chunks + 1)
    return jit_bear_witness(replace(cache, stats=stats), camera, depths, confidences, config)


def confidence_after(pivot_depth: float, *views, start: float = 0.6, config=CONFIG) -> float:
    """Confidence of one pivot on the axis of the front camera after `views` (depths, confidences)."""
    cache = with_pivots([[0.0, 0.0, pivot_depth]], confidences=[start])
    for depths, confidences in views:
        cache = jit_carve(cache, front_camera(), depths, confidences, config)
    return float(cache.confidences[0, 0])


@SETTINGS
@given(scene_seed=SEED, camera_seed=SEED, num_voxels=st.integers(0, CAPACITY), depth_spread=DEPTHS)
def test_carving_equals_the_reference(scene_seed, camera_seed, num_voxels, depth_spread):
    cache, camera = scene(scene_seed, num_voxels, depth_spread), cameras(camera_seed)
    depths, confidences = random_views(camera_seed)
    wanted = reference.from_arrays(cache)
    margin = reference.carve(wanted, camera.viewmats, camera.Ks, depths, confidences, CONFIG)
    assume(margin > DECISION_MARGIN)
    got = jit_carve(cache, camera, jnp.asarray(depths), jnp.asarray(confidences), CONFIG)
    for row, (_, pivots) in enumerate(wanted["rows"]):
        expected = [pivot["confidences"] for pivot in pivots]
        np.testing.assert_allclose(got.confidences[row, : len(pivots)], expected, rtol=2e-6)
    jax.tree.map(np.testing.assert_array_equal, replace(got, confidences=cache.confidences), cache)


def test_free_space_sinks_seen_rises_hidden_stays():
    assert confidence_after(1.0, seen(2.0)) < 0.6
    assert confidence_after(2.0, seen(2.0)) > 0.6
    assert confidence_after(3.0, seen(2.0)) == np.float32(0.6)


def test_contradiction_outweighs_agreement():
    """Both are weighted by the confidence of the witness."""
    contradicted, agreed = confidence_after(1.0, seen(2.0)), confidence_after(2.0, seen(2.0))
    assert 0.6 - contradicted > agreed - 0.6
    assert confidence_after(1.0, seen(2.0, 0.6)) > contradicted
    assert confidence_after(2.0, seen(2.0, 0.6)) < agreed


def test_the_order_of_witnesses_does_not_matter():
    # Far enough from both bounds: a clipped confidence forgets how far outside it would have been.
    witnesses = (seen(2.0, 0.7), seen(1.0, 0.5), seen(2.0, 0.5))
    assert confidence_after(1.0, *witnesses) == pytest.approx(confidence_after(1.0, *witnesses[::-1]), rel=1e-5)


def test_confidences_stay_revisable():
    sunk = confidence_after(1.0, *[seen(2.0, 1.0)] * 50)
    assert sunk == pytest.approx(0.02)
    assert confidence_after(1.0, *[seen(2.0, 1.0)] * 50, *[seen(1.0, 1.0)] * 20) > 0.5
    assert confidence_after(1.0, *[seen(1.0, 1.0)] * 50) == pytest.approx(0.95)


@pytest.mark.parametrize(
    "witness",
    [
        seen(2.0, CONFIG.memory.min_confidence - 0.01),
        seen(2.0, 0.0),
        seen(np.nan),
        seen(np.inf),
        seen(-1.0),
        seen(2.0, np.nan),
    ],
    ids=["low_confidence", "zero_confidence", "nan", "infinite", "negative", "nan_confidence"],
)
def test_untrusted_cells_change_nothing(witness):
    assert confidence_after(1.0, witness) == np.float32(0.6)


def test_an_untrusted_neighbor_forbids_carving_but_not_agreement():
    depths, confidences = seen(2.0)
    for row, column in ((2, 3), (3, 5), (4, 4)):
        views = (depths, confidences.at[0, row, column].set(0.1))
        assert confidence_after(1.0, views) == np.float32(0.6)
        assert confidence_after(2.0, views) > 0.6


def test_without_carving_nothing_is_computed():
    off = CONFIG.replace(carving=False)
    assert confidence_after(1.0, seen(2.0), config=off) == np.float32(0.6)
    inputs = (with_pivots([[0.0, 0.0, 1.0]]), front_camera(), *seen(2.0))
    assert not jax.make_jaxpr(lambda *args: carve(*args, off))(*inputs).eqns


@settings(SETTINGS, max_examples=6)  # two chunks each, also in the slow reference
@given(seed=SEED, camera_seed=SEED, size=st.sampled_from([(HEIGHT, GRID_WIDTH), (40, 33)]))
def test_judging_equals_the_reference(seed, camera_seed, size):
    height, width = size
    cache, views, rng = init_cache(CONFIG, CAPACITY), [], np.random.default_rng(seed)
    for chunk in range(2):
        camera = cameras(camera_seed + chunk)
        scale = jnp.array([width / GRID_WIDTH, height / HEIGHT, 1.0])[:, None]
        camera = Camera(viewmats=camera.viewmats, Ks=camera.Ks * scale, width=width, height=height)
        depths, confidences = random_views(seed + chunk, height, width)
        cache = after_chunk(cache, camera, depths, confidences)
        witness = reference.witness(camera.viewmats, camera.Ks, depths, confidences, WITNESS_CELLS, CONFIG)
        views.append(witness)
        viewmat, K, nearest, _, weights = witness
        np.testing.assert_array_equal(cache.witnesses.viewmats[chunk], viewmat)
        np.testing.assert_allclose(cache.witnesses.Ks[chunk], K, rtol=1e-6)
        np.testing.assert_allclose(cache.witnesses.weights[chunk], weights, rtol=1e-6)
        has_weight = weights > 0
        np.testing.assert_allclose(cache.witnesses.log_depths[chunk][has_weight], nearest[has_weight], atol=1e-6)
    tokens = tokens_at(
        rng.uniform(-1, 1, (200, 3)), rng.choice([0.2, 0.4, 0.6, 0.9], 200), valid=rng.uniform(size=200) < 0.9
    )
    arrays = {name: np.asarray(getattr(tokens, name)) for name in ("means", "confidences", "valid")}
    wanted, margin = reference.judge(views, arrays, CONFIG)
    assume(margin > DECISION_MARGIN / 4)  # smaller than elsewhere: 400 pairs hardly ever keep the full margin
    got = jit_judge(cache.witnesses, tokens, CONFIG)
    np.testing.assert_allclose(got.confidences, wanted, rtol=2e-5)
    jax.tree.map(np.testing.assert_array_equal, replace(got, confidences=tokens.confidences), tokens)


def judged(mean, confidence=0.6, valid=True, config=CONFIG) -> float:
    """Confidence of a token after one chunk whose view saw a wall at depth 2."""
    cache = after_chunk(init_cache(config, CAPACITY), front_camera(), *seen(2.0), config)
    token = tokens_at([mean], [confidence], valid=[valid])
    return float(jit_judge(cache.witnesses, token, config).confidences[0])


def test_tokens_are_judged_by_views_of_earlier_chunks():
    assert judged([0, 0, 1.9]) < 0.6 < judged([0, 0, 1.99])
    assert judged([0, 0, 2.1]) > 0.6
    unchanged = np.float32(0.6)
    assert judged([0, 0, 3.0]) == unchanged  # hidden
    assert judged([0, 0, -1.0]) == judged([5.0, 0, 1.0]) == unchanged  # unseen
    assert judged([0, 0, np.nan]) == judged([0, np.inf, 1.0]) == unchanged
    assert judged([0, 0, 1.0], valid=False) == unchanged
    assert judged([0, 0, 1.0], confidence=0.2) == np.float32(0.2)  # below tau: it never enters the cache
    assert np.isnan(judged([0, 0, 1.0], confidence=np.nan))


def test_best_view_is_stored_and_the_oldest_chunk_replaced(monkeypatch):
    monkeypatch.setattr("ssplat_jax.cache.state.NUM_WITNESSES", 2)
    config = CONFIG
    cache = init_cache(config, CAPACITY)
    camera = cameras(3)
    for chunk in range(3):
        depths = np.full((2, HEIGHT, GRID_WIDTH), 2.0 + chunk, np.float32)
        confidences = np.full_like(depths, 0.8)
        confidences[1 - chunk % 2, 0, 0] = 0.0  # so that the other view has one trusted cell more
        cache = after_chunk(cache, camera, depths, confidences, config)
        np.testing.assert_array_equal(cache.witnesses.viewmats[chunk % 2], camera.viewmats[chunk % 2])
    np.testing.assert_allclose(np.exp(cache.witnesses.log_depths.max(axis=(1, 2))), [4.0, 3.0], rtol=1e-6)


def test_padding_displaces_no_witness():
    config = CONFIG
    before = after_chunk(init_cache(config, CAPACITY), front_camera(), *seen(2.0), config)
    after = jit_bear_witness(before, front_camera(), *seen(3.0, 0.0), config)
    jax.tree.map(np.testing.assert_array_equal, after, before)


def test_without_carving_nothing_is_judged():
    off = CONFIG.replace(carving=False)
    assert judged([0, 0, 1.0], config=off) == np.float32(0.6)
    cache, token = init_cache(off, CAPACITY), tokens_at([[0, 0, 1.0]], [0.6])
    assert cache.witnesses.weights.size == 0
    assert not jax.make_jaxpr(lambda *args: judge(*args, off))(cache.witnesses, token).eqns
    assert not jax.make_jaxpr(lambda *args: store_witness(*args, off))(cache, front_camera(), *seen(2.0)).eqns
