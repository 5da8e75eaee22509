"""Rows in sight are those of brute force, and what folds over them does not depend on how they are cut into blocks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from ssplat_jax.cache import add_sightings, carve, pixel_pairs
from ssplat_jax.cache.pixel_pairs import NEAR, fold_pairs, rows_in_sight
from ssplat_jax.cache.sightings import cells_of
from tests.cache.projection_scenes import DECISION_MARGIN, DEPTHS, SEED, SETTINGS, cameras, scene
from tests.cache.streams import CAPACITY, CONFIG
from tests.cache.test_carve import random_views

LEAST_CONFIDENCE = 0.4  # between those of the scenes


@SETTINGS
@given(scene_seed=SEED, camera_seed=SEED, num_voxels=st.integers(0, CAPACITY), depth_spread=DEPTHS)
def test_rows_in_sight_are_those_of_brute_force(scene_seed, camera_seed, num_voxels, depth_spread):
    cache, camera = scene(scene_seed, num_voxels, depth_spread), cameras(camera_seed)
    means = np.concatenate([cache.means, np.ones((*cache.means.shape[:2], 1))], axis=-1).astype(np.float64)
    x = np.einsum("vij,nkj->vnki", np.asarray(camera.viewmats, np.float64), means)[..., :3]
    z = np.where(np.abs(x[..., 2]) > 1e-9, x[..., 2], 1e-9)
    pixels = np.einsum("vij,vnkj->vnki", np.asarray(camera.Ks, np.float64), x / z[..., None])[..., :2]
    ends = [camera.width, camera.height]
    edges = np.minimum(np.abs(pixels), np.abs(pixels - ends)).min(axis=-1)
    alive = np.asarray(cache.alive) & (np.asarray(cache.confidences) >= LEAST_CONFIDENCE)
    assume(np.minimum(np.abs(z - NEAR), edges)[:, alive].min(initial=np.inf) > DECISION_MARGIN)
    is_inside = (z > NEAR) & (pixels >= 0).all(axis=-1) & (pixels < ends).all(axis=-1)
    wanted = np.flatnonzero((is_inside & alive).any(axis=(0, 2)))
    found = jax.jit(rows_in_sight, static_argnames="min_confidence")(cache, camera, min_confidence=LEAST_CONFIDENCE)
    assert found.number == len(wanted)
    np.testing.assert_array_equal(found.rows[: len(wanted)], wanted)


def test_a_fold_visits_every_row_in_sight_once_and_no_other(monkeypatch):
    monkeypatch.setattr(pixel_pairs, "ROWS_PER_BLOCK", 4)
    cache, camera = scene(3, CAPACITY - 1, 6.0), cameras(4)
    in_sight = rows_in_sight(cache, camera)
    assert 4 < in_sight.number < cache.num_voxels and in_sight.number % 4  # several blocks, the last one partly empty

    def visit(counts, pairs, rows, is_row):
        is_seen = (pairs.weights > 0).reshape(len(camera.viewmats), len(rows), -1).any(axis=(0, 2))
        return counts[0].at[rows].add(is_row.astype(int)), counts[1].at[rows].add(is_seen.astype(int))

    zeros = jnp.zeros(CAPACITY, int)
    visits, seen = fold_pairs(cache, camera, in_sight, visit, (zeros, zeros))
    wanted = np.zeros(CAPACITY, int)
    wanted[np.asarray(in_sight.rows[: int(in_sight.number)])] = 1
    np.testing.assert_array_equal(visits, wanted)
    np.testing.assert_array_equal(seen, wanted)


@pytest.mark.parametrize("field", ["confidences", "sightings"])
def test_block_size_changes_nothing_that_views_revise(monkeypatch, field):
    cache, camera = scene(7, CAPACITY - 3, 0.1), cameras(8)
    depths, confidences = map(jnp.asarray, random_views(8))
    rgbs = jnp.full((depths.size, 3 * CONFIG.head.gaussians_per_token), 0.5)

    def revised(cache):
        if field == "confidences":
            return carve(cache, camera, depths, confidences, CONFIG).confidences
        return add_sightings(cache, camera, cells_of(depths, confidences, rgbs, CONFIG), CONFIG).sightings

    whole = jax.jit(revised)(cache)
    assert np.any(whole != getattr(cache, field))
    monkeypatch.setattr(pixel_pairs, "ROWS_PER_BLOCK", 4)
    np.testing.assert_allclose(jax.jit(lambda cache: revised(cache))(cache), whole, rtol=1e-6, atol=1e-6)
