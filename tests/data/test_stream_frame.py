"""Stream frames: points come back from them, and Gaussians look the same."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ssplat_jax.data.stream_frame import StreamFrame
from tests.scene_files.scene_fixture import assert_turned, scene

FLOAT64_ROUNDING = 1e-12
FLOAT32_ROUNDING = 2e-6

EARTH = np.array([4.2e6, 6.1e5, 4.7e6])  # earth-centered meters, where float32 has a spacing of 0.5 m


def frame_at(rng, center, scale=1.7):
    """Stream frame of a camera at a place, turned at random."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.random(random_state=rng).as_matrix(), center
    return StreamFrame.at_camera(pose, scale=scale, near=0.5, far=8.0)


def test_points_survive_a_round_trip():
    rng = np.random.default_rng(0)
    frame, points = frame_at(rng, EARTH), EARTH + rng.normal(size=(50, 3))
    back = frame.points_to_capture(frame.points_to_stream(points))
    np.testing.assert_allclose(back, points, rtol=0, atol=FLOAT64_ROUNDING * EARTH.max())


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_gaussians_in_the_capture_frame_are_the_same_ellipsoids_in_the_same_colors(degree):
    frame, before = frame_at(np.random.default_rng(5), [3.0, -2.0, 1.0], scale=0.4), scene(degree)
    after = frame.gaussians_to_capture(before)
    means = np.asarray(after.means, np.float64)
    np.testing.assert_allclose(frame.points_to_stream(means), before.means, rtol=0, atol=4 * FLOAT32_ROUNDING)
    assert_turned(after, before, frame.rotation, 1 / frame.scale)
    np.testing.assert_array_equal(after.opacities, before.opacities)


def test_a_small_scene_far_from_the_origin_keeps_its_points():
    """A scene of centimeters in units of kilometers: an offset in whole units would be zero."""
    frame, before = frame_at(np.random.default_rng(6), [0.3, -0.4, 0.2], scale=1e6), scene(0)
    assert any(frame.offset) and np.abs(frame.origin - frame.offset).max() <= 0.5 / frame.scale
    means = np.asarray(frame.gaussians_to_capture(before).means, np.float64) + frame.offset
    np.testing.assert_allclose(frame.points_to_stream(means), before.means, rtol=0, atol=4 * FLOAT32_ROUNDING)
