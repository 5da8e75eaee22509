"""Camera paths: they pass through every given camera, are smooth, and have rigid poses."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ssplat_jax.data.camera_path import SWAY_RADIUS, camera_path, look_at, looked_at, orbit_path, upward

K = np.array([[50.0, 0.0, 32.0], [0.0, 50.0, 24.0], [0.0, 0.0, 1.0]])


def poses(rotvecs, centers):
    camtoworlds = np.tile(np.eye(4), (len(centers), 1, 1))
    camtoworlds[:, :3, :3] = Rotation.from_rotvec(rotvecs).as_matrix()
    camtoworlds[:, :3, 3] = centers
    return camtoworlds


def wandering(n=7, seed=0):
    rng = np.random.default_rng(seed)
    return poses(rng.normal(size=(n, 3)) * 0.4, rng.normal(size=(n, 3)) + 6.4e6)


@pytest.mark.parametrize("steps", [1, 2, 7])
def test_the_path_passes_through_every_camera(steps):
    given = wandering()
    Ks = K * np.linspace(1, 2, 7)[:, None, None]
    path, path_Ks = camera_path(given, Ks, steps)
    assert len(path) == len(path_Ks) == 6 * steps + 1
    assert np.abs(path[::steps] - given).max() < 1e-8  # relative to the coordinates: 1e-15
    assert np.abs(path_Ks[::steps] - Ks).max() < 1e-12
    np.testing.assert_allclose(path_Ks[:, 0, 0], np.linspace(50, 100, 6 * steps + 1))


def test_every_pose_on_the_path_is_rigid_and_the_path_is_smooth():
    steps = 200
    path, _ = camera_path(wandering(), np.tile(K, (7, 1, 1)), steps)
    rotations = path[:, :3, :3]
    assert np.abs(np.einsum("nij,nik->njk", rotations, rotations) - np.eye(3)).max() < 1e-12
    assert np.linalg.det(rotations) == pytest.approx(1.0)
    np.testing.assert_array_equal(path[:, 3], np.tile([0.0, 0.0, 0.0, 1.0], (len(path), 1)))
    velocities = np.diff(path[:, :3], axis=0) * steps
    changes = np.abs(np.diff(velocities, axis=0)).max(axis=(1, 2))
    assert changes.max() < 0.15  # a corner would change the velocity by its own size
    assert np.abs(velocities).max() > 1.0


def inward(num_cameras, height=0.4, radius=2.0, target=(1.0, -2.0, 3.0)):
    """Cameras on half a circle about z, which look at a point from above it; each a little off its place."""
    angles = np.linspace(0, np.pi, num_cameras)
    arms = np.stack([radius * np.cos(angles), radius * np.sin(angles), np.full(num_cameras, height)], axis=1)
    up = np.array([0.0, 0.0, 1.0])
    return np.stack([look_at(target + arm, np.array(target), up) for arm in arms])


def test_an_orbit_is_a_circle_through_cameras_that_look_at_one_point():
    given = inward(9)
    path, Ks = orbit_path(given, K, 1.0, 16)
    np.testing.assert_array_equal(Ks, np.tile(K, (16, 1, 1)))
    # From one camera a half circle away is eight sixteenths: the ninth of the path is the last given one, mirrored.
    np.testing.assert_allclose(path[0], given[0], atol=1e-3)
    np.testing.assert_allclose(path[8], given[8], atol=1e-3)
    arms = path[:, :3, 3] - [1.0, -2.0, 3.0]
    np.testing.assert_allclose(np.linalg.norm(arms, axis=1), np.hypot(2.0, 0.4), rtol=1e-3)
    np.testing.assert_allclose(path[:, :3, 2], -arms / np.linalg.norm(arms, axis=1, keepdims=True), atol=1e-6)
    steps = np.linalg.norm(np.diff(path[:, :3, 3], axis=0, append=path[:1, :3, 3]), axis=1)
    np.testing.assert_allclose(steps, steps[0], rtol=1e-9)  # closed and even


def test_cameras_that_look_outward_sway_about_the_middle_one():
    given = inward(9)
    given[:, :3, [0, 2]] *= -1
    path, _ = orbit_path(given, K, 5.0, 12)
    middle, target = given[4, :3, 3], given[4, :3, 3] + 5.0 * given[4, :3, 2]
    np.testing.assert_allclose(np.linalg.norm(path[:, :3, 3] - middle, axis=1), SWAY_RADIUS * 5.0)
    toward = target - path[:, :3, 3]
    np.testing.assert_allclose(path[:, :3, 2], toward / np.linalg.norm(toward, axis=1, keepdims=True), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(path[:, :3, :3]), 1.0)
    assert (np.einsum("nj,j->n", path[:, :3, 1], given[4, :3, 1]) > 0.9).all()  # upright


@pytest.mark.parametrize("share", [0.3, 0.4])
def test_up_is_that_of_level_cameras_though_some_lie_on_a_side(share):
    angles = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    up = np.array([0.0, 0.0, 1.0])
    given = np.stack([look_at(np.array([np.cos(a), np.sin(a), 0.0]), np.zeros(3), up) for a in angles])
    quarter_turn = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    given[: round(share * 40), :3, :3] @= quarter_turn
    found = upward(given)
    assert found is not None and np.degrees(np.arccos(min(1.0, found @ up))) < 1.0


def test_cameras_that_turn_about_one_place_look_at_no_point():
    """Their axes meet at their own place, which rounding puts in front of all of them now and then."""
    for seed in range(50):
        rng = np.random.default_rng(seed)
        turning = poses(rng.normal(size=(3, 3)) * 0.4, np.tile(rng.normal(size=3), (3, 1)))
        assert looked_at(turning, 2.0) is None
        path, _ = orbit_path(turning, K, 2.0, 8)
        assert np.isfinite(path).all()
        radii = np.linalg.norm(path[:, :3, 3] - turning[1, :3, 3], axis=1)
        np.testing.assert_allclose(radii, SWAY_RADIUS * 2.0)
