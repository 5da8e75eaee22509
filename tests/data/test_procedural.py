"""Procedural samples: determinism, free space, units and parallax."""

import numpy as np
import pytest

from ssplat_jax.data.procedural import procedural_views
from ssplat_jax.data.procedural.paths import PATH_KINDS, sample_path
from ssplat_jax.data.procedural.procedural_views import procedural_capture_arrays, training_sample
from ssplat_jax.data.procedural.scene import Finish, SceneBuilder, clearance, fade_scene
from ssplat_jax.data.procedural.scenes import SCENE_KINDS, sample_scene
from ssplat_jax.data.procedural.textures import texture_library

NUM_SEEDS = 10
MARGIN = 1.02  # the low-resolution probe slightly misses the nearest and farthest points


@pytest.fixture(scope="module")
def samples():
    return [training_sample(seed, 6, 24, 32) for seed in range(NUM_SEEDS)]


def test_units_of_training_samples(samples):
    medians = np.array([np.median(depths) for _, depths, _, _ in samples])
    assert medians.min() > 1.2 / 1.1 and medians.max() < 3.5 * 1.1
    assert medians.std() > 0.3
    for _, depths, _, _ in samples:
        assert depths.min() > 0.3 / MARGIN
        assert depths.max() < 15.0 * MARGIN


@pytest.fixture(scope="module")
def yards():
    return [training_sample(seed, 6, 24, 32, kinds=("yard",)) for seed in range(12)]


def test_the_sky_of_yards_is_infinitely_far_and_does_not_count_as_a_surface(yards):
    shares = []
    for _, depths, _, _ in yards:
        shares.append(np.isinf(depths).mean())
        surfaces = depths[np.isfinite(depths)]
        assert 1.2 / 1.1 < np.median(surfaces) < 3.5 * 1.1
        # The probe of few pixels can miss the ground near the horizon.
        assert surfaces.min() > 0.3 / MARGIN and np.quantile(surfaces, 0.98) < 15.0 * MARGIN
    # The sky is in most of them, and fills the smaller part of each.
    assert np.mean(np.array(shares) > 0.02) > 0.6 and max(shares) < 0.6


@pytest.mark.parametrize("kind", SCENE_KINDS)
def test_only_yards_have_a_sky_that_is_infinitely_far(kind, monkeypatch):
    """The sky of a street is a dome, however far: a nearer limit changes the samples of yards alone."""
    usual = training_sample(5, 6, 24, 32, kinds=(kind,))
    monkeypatch.setattr(procedural_views, "SKY_DISTANCE", 6.0)
    nearer = training_sample(5, 6, 24, 32, kinds=(kind,))
    assert all(np.array_equal(a, b) for a, b in zip(usual, nearer, strict=True)) == (kind != "yard")


def test_same_seed_same_sample(samples):
    for a, b in zip(samples[7], training_sample(7, 6, 24, 32), strict=True):
        np.testing.assert_array_equal(a, b)
    assert not np.array_equal(samples[7][1], samples[8][1])


@pytest.mark.parametrize("kind", SCENE_KINDS)
@pytest.mark.parametrize("path", PATH_KINDS)
def test_cameras_stay_in_free_space(kind, path):
    """Some paths may fail: `training_sample` discards scenes that are too full for a path to start."""
    free = []
    for seed in range(6):
        scene = sample_scene(seed, kind)
        poses, _ = sample_path(seed, scene, path, 12, 24, 32, step=0.05 * float(scene.orbit_radius))
        free.append(clearance(scene, poses[:, :3, 3]).min())
    assert np.mean(np.array(free) > 0.25) >= 4 / 6


def test_clearance_is_the_distance_to_analytic_solids():
    b = SceneBuilder(np.random.default_rng(2), texture_library())
    finish = Finish((0,))
    b.shell([0, 0, 0], [5, 5, 5], finish, finish, finish)
    b.dome(100.0, finish)
    b.box([2, 0, 0], [1, 0.5, 0.5], finish)
    b.add("ball", [-2, 0, 0], 0.7, finish)
    b.add("cylinder", [0, 0, 3], [0.5, 1, 0.5], finish)
    scene = b.build(focus=[0, 0, 0], orbit_radius=1.0, eye=[0, 0, 0])
    points = np.array([[0, 0, 0], [2, -1, 0], [-2, 0, 0.9], [0, 0, 2], [4.9, 4, 4], [2, 0, 0], [0.0, 0, 6]])
    np.testing.assert_allclose(clearance(scene, points), [1.0, 0.5, 0.2, 0.5, 0.1, -0.5, -1.0], atol=1e-6)


def test_revisit_returns_to_places_that_it_saw_and_hardly_moves_there():
    images, depths, poses, _ = procedural_capture_arrays("revisit", 48, 24, 32)
    centers, gazes = poses[:, :3, 3], poses[:, :3, 2]
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=-1)
    returns = np.arange(24, 47) % 6 != 5  # steps within one of the four places
    assert steps[24:][returns[: len(steps[24:])]].max() < 0.02 * np.median(depths)
    assert steps[:23].min() > 5 * np.median(steps[24:])
    seen_before = (gazes[24:] @ gazes[:24].T).max(axis=1)
    assert seen_before.min() > np.cos(np.radians(10)), "a later view looks where an earlier one looked"
    assert np.median(depths[24:]) < np.median(depths[:24]), "and is nearer"
    assert depths.min() > 0.3
    assert np.median(np.abs(images[31] - images[30])) > 0.005, "nearly one pose; they differ by noise"


def test_laps_walk_the_path_of_the_room_again_and_again():
    (_, depths, poses, _), (_, once, path, _) = (
        procedural_capture_arrays(name, frames, 24, 32) for name, frames in (("laps", 97), ("room", 10))
    )
    again = np.arange(97) % 10
    np.testing.assert_allclose(poses, path[again], atol=1e-5)
    np.testing.assert_allclose(np.median(depths - once[again], axis=(1, 2)), 0, atol=1e-4)


def test_fading_keeps_the_scene_or_takes_all_texture_away():
    scene = sample_scene(3, "room")
    np.testing.assert_array_equal(fade_scene(scene, 1.0).faces, scene.faces)
    flat, half = fade_scene(scene, 0.0).faces, fade_scene(scene, 0.5).faces
    assert (flat[..., 9:12] == 0).all()
    np.testing.assert_allclose(half, (flat + scene.faces) / 2, atol=1e-6)
    at_middle = scene.faces[..., 9:12] * 0.45 + scene.faces[..., 12:15]
    np.testing.assert_allclose(flat[..., 12:15], at_middle, atol=1e-6)


def test_bright_skies_are_white(yards):
    """Some skies are overexposed, and some are not."""
    white = [
        (images[np.isinf(depths)].min(axis=-1) > 0.99).mean()
        for images, depths, _, _ in yards
        if np.isinf(depths).any()
    ]
    assert max(white) > 0.9 and min(white) < 0.1
