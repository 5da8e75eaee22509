"""Camera paths: they pass through every given camera, are smooth, and have rigid poses."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ssplat_jax.runs.scene_outputs import camera_path, upward

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
    path, _ = camera_path(wandering(), np.tile(K, (7, 1, 1)), steps=200)
    rotations = path[:, :3, :3]
    assert np.abs(np.einsum("nij,nik->njk", rotations, rotations) - np.eye(3)).max() < 1e-12
    assert np.linalg.det(rotations) == pytest.approx(1.0)
    np.testing.assert_array_equal(path[:, 3], np.tile([0.0, 0.0, 0.0, 1.0], (len(path), 1)))
    velocities = np.diff(path[:, :3], axis=0) * 200
    changes = np.abs(np.diff(velocities, axis=0)).max(axis=(1, 2))
    assert changes.max() < 0.15  # a corner would change the velocity by its own size
    assert np.abs(velocities).max() > 1.0
    straight, _ = camera_path(poses(np.zeros((4, 3)), np.arange(12.0).reshape(4, 3)), np.tile(K, (4, 1, 1)), steps=5)
    np.testing.assert_allclose(np.diff(straight[:, :3, 3], axis=0), 0.6, rtol=1e-12)  # no stop at a camera


@pytest.mark.parametrize("share", [0.3, 0.4])
def test_up_is_that_of_level_cameras_though_some_lie_on_a_side(share):
    angles, up = np.linspace(0, 2 * np.pi, 40, endpoint=False), np.array([0.0, 0.0, 1.0])
    level = [[-1.0, 0, 0], [0, 0, -1.0], [0, -1.0, 0]]  # right, down and forward at angle 90 degrees
    given = np.tile(np.eye(4), (40, 1, 1))
    given[:, :3, :3] = Rotation.from_rotvec(angles[:, None] * up).as_matrix() @ np.transpose(level)
    given[: round(share * 40), :3, :3] @= Rotation.from_euler("z", 90, degrees=True).as_matrix()
    found = upward(given)
    assert found is not None and np.degrees(np.arccos(min(1.0, found @ up))) < 1.0
