"""Carving against its NumPy oracle, and what a witness may and may not do."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from ssplat_jax.cache import carve, reference
from ssplat_jax.struct import replace
from tests.cache.streams import CAPACITY, CONFIG
from tests.cache.test_project_oracle import (
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

jit_carve = jax.jit(carve, static_argnums=4)
SHAPE = (1, HEIGHT, GRID_WIDTH)


def seen(depth: float, confidence: float = 0.8):
    """Every cell of the front camera sees the same."""
    return jnp.full(SHAPE, depth), jnp.full(SHAPE, confidence)


def confidence_after(pivot_depth: float, *views, start: float = 0.6, config=CONFIG) -> float:
    """Of one pivot on the axis of the front camera, after witnesses (depths, confidences)."""
    cache = with_pivots([[0.0, 0.0, pivot_depth]], confidences=[start])
    for depths, confidences in views:
        cache = jit_carve(cache, front_camera(), depths, confidences, config)
    return float(cache.confidences[0, 0])


@SETTINGS
@given(scene_seed=SEED, camera_seed=SEED, num_voxels=st.integers(0, CAPACITY), depth_spread=DEPTHS)
def test_carving_equals_the_loop(scene_seed, camera_seed, num_voxels, depth_spread):
    cache, camera = scene(scene_seed, num_voxels, depth_spread), cameras(camera_seed)
    rng = np.random.default_rng(camera_seed)
    shape = (2, HEIGHT, GRID_WIDTH)
    depths = rng.uniform(2.5, 5.5, shape).astype(np.float32)
    depths.reshape(-1)[:3] = [np.nan, np.inf, 0.0]
    confidences = rng.choice([0.0, 0.45, 0.6, 0.7, 0.8, 0.9, 1.0], shape).astype(np.float32)
    wanted = reference.from_arrays(cache)
    margin = reference.carve(wanted, camera.viewmats, camera.Ks, depths, confidences, CONFIG)
    assume(margin > DECISION_MARGIN)
    got = jit_carve(cache, camera, jnp.asarray(depths), jnp.asarray(confidences), CONFIG)
    for row, (_, pivots) in enumerate(wanted["rows"]):
        expected = [pivot["confidences"] for pivot in pivots]
        np.testing.assert_allclose(got.confidences[row, : len(pivots)], expected, rtol=2e-6)
    jax.tree.map(np.testing.assert_array_equal, replace(got, confidences=cache.confidences), cache)


def test_looked_through_sinks_seen_rises_hidden_stays():
    assert confidence_after(1.0, seen(2.0)) < 0.6
    assert confidence_after(2.0, seen(2.0)) > 0.6
    assert confidence_after(3.0, seen(2.0)) == np.float32(0.6)


def test_a_contradiction_weighs_more_than_an_agreement_and_both_by_their_confidence():
    contradicted, agreed = confidence_after(1.0, seen(2.0)), confidence_after(2.0, seen(2.0))
    assert 0.6 - contradicted > agreed - 0.6
    assert confidence_after(1.0, seen(2.0, 0.6)) > contradicted
    assert confidence_after(2.0, seen(2.0, 0.6)) < agreed


def test_the_order_of_witnesses_does_not_matter():
    # Far enough from both bounds: a clipped belief forgets how far beyond the bound it would have been.
    witnesses = (seen(2.0, 0.7), seen(1.0, 0.5), seen(2.0, 0.5))
    assert confidence_after(1.0, *witnesses) == pytest.approx(confidence_after(1.0, *witnesses[::-1]), rel=1e-5)


def test_beliefs_stay_revisable():
    sunk = confidence_after(1.0, *[seen(2.0, 1.0)] * 50)
    assert sunk == pytest.approx(0.02)
    assert confidence_after(1.0, *[seen(2.0, 1.0)] * 50, *[seen(1.0, 1.0)] * 20) > 0.5
    assert confidence_after(1.0, *[seen(1.0, 1.0)] * 50) == pytest.approx(0.95)


@pytest.mark.parametrize(
    "witness",
    [
        seen(2.0, CONFIG.min_confidence - 0.01),
        seen(2.0, 0.0),
        seen(np.nan),
        seen(np.inf),
        seen(-1.0),
        seen(2.0, np.nan),
    ],
    ids=["unsure", "blind", "nan", "infinite", "negative", "nan_confidence"],
)
def test_no_witness_no_change(witness):
    assert confidence_after(1.0, witness) == np.float32(0.6)


def test_an_untrusted_neighbour_forbids_carving_but_not_agreement():
    depths, confidences = seen(2.0)
    for row, column in ((2, 3), (3, 5), (4, 4)):
        unsure = (depths, confidences.at[0, row, column].set(0.1))
        assert confidence_after(1.0, unsure) == np.float32(0.6)
        assert confidence_after(2.0, unsure) > 0.6


def test_switched_off_it_is_the_identity_and_leaves_no_trace():
    off = CONFIG.replace(carving=False)
    assert confidence_after(1.0, seen(2.0), config=off) == np.float32(0.6)
    inputs = (with_pivots([[0.0, 0.0, 1.0]]), front_camera(), *seen(2.0))
    assert not jax.make_jaxpr(lambda *args: carve(*args, off))(*inputs).eqns
