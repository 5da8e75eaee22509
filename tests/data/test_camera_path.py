"""Camera paths: they pass through every given camera, are smooth, and have rigid poses."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ssplat_jax.data.camera_path import camera_path

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


def test_uniform_motion_stays_uniform():
    rotvecs, centers = np.arange(5)[:, None] * [0.0, 0.3, 0.0], np.arange(5)[:, None] * [1.0, -2.0, 0.5]
    path, _ = camera_path(poses(rotvecs, centers), np.tile(K, (5, 1, 1)), 10)
    np.testing.assert_allclose(path[:, :3, 3], np.arange(41)[:, None] / 10 * [1.0, -2.0, 0.5], atol=1e-12)
    angles = Rotation.from_matrix(path[:, :3, :3]).as_rotvec()
    assert np.abs(angles[:, [0, 2]]).max() < 1e-12
    # Equal parts of a chord are nearly equal parts of the arc; the deviation is largest at the ends.
    assert np.abs(angles[:, 1] - 0.03 * np.arange(41)).max() < 2e-3


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


def test_cameras_looking_apart_are_joined_by_rotations():
    angle = np.radians(120)
    path, _ = camera_path(poses([[0, 0, 0], [0, angle, 0]], np.zeros((2, 3))), np.tile(K, (2, 1, 1)), 30)
    turns = Rotation.from_matrix(path[:, :3, :3]).as_rotvec()
    assert np.abs(turns[:, [0, 2]]).max() < 1e-9
    assert (np.diff(turns[:, 1]) > 0).all() and turns[-1, 1] == pytest.approx(angle)


def test_one_camera_is_its_own_path():
    given = wandering(1)
    path, Ks = camera_path(given, K[None], 5)
    np.testing.assert_array_equal(path, given)
    np.testing.assert_array_equal(Ks, K[None])
