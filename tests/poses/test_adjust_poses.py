"""Adjusted poses of a small room: wrong ones are found and put right, exact ones stay, and nothing else is touched."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ssplat_jax.data.capture import ArrayPixels, Capture
from ssplat_jax.data.posed_image import Frame
from ssplat_jax.poses.adjust_poses import adjust_poses
from tests.data.capture_fixture import with_poses
from tests.poses.room_fixture import HEIGHT, WIDTH, K, pictures, walk
from tests.poses.test_bundle_adjustment import relative_turns

NUM = 6
CONTEXT = [i for i in range(NUM) if i != 4]


@pytest.fixture(scope="module")
def exact():
    poses = walk(NUM)
    frames = tuple(Frame(f"{i}.png", pose, K, WIDTH, HEIGHT) for i, pose in enumerate(poses))
    images = np.stack(pictures(poses)).astype(np.float32) / 255
    return Capture("room", "test", frames, ArrayPixels(images, np.zeros(images.shape[:3], np.float32)), WIDTH, HEIGHT)


@pytest.fixture(scope="module")
def wrong(exact):
    rng, poses = np.random.default_rng(0), exact.camtoworlds
    for i in CONTEXT[1:]:
        turn, shift = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
        poses[i, :3, :3] @= Rotation.from_rotvec(np.radians(0.5) * turn).as_matrix()
        poses[i, :3, 3] += 0.02 * shift  # 1 % of the depth
    return with_poses(exact, poses)


@pytest.fixture(scope="module")
def adjusted(wrong):
    return adjust_poses(wrong, CONTEXT)


def turns(capture, exact):
    """Degrees by which the motion from each context camera to the next differs from the exact one."""
    return relative_turns(*(np.linalg.inv(c.camtoworlds[CONTEXT]) for c in (capture, exact)))


def test_wrong_poses_are_found_and_put_right(adjusted, wrong, exact):
    assert adjusted.error_before > 0.3
    assert turns(adjusted.capture, exact).mean() < turns(wrong, exact).mean() / 3
    assert adjusted.error_after < adjusted.error_before / 3


def test_exact_poses_hardly_move(exact):
    found = adjust_poses(exact, CONTEXT)
    assert found.turn < 0.1 and found.error_before < 0.25


def test_the_frame_and_the_unit_of_the_poses_stay_and_frames_that_are_not_named_are_not_looked_at(adjusted, wrong):
    """The capture in millimeters, 10 km away and turned, has the same adjustment, whatever frame 4 shows."""
    assert adjusted.capture.frames[4] is wrong.frames[4]
    images = np.stack([wrong.image(i) for i in range(NUM)])
    images[4] = np.nan
    blind = ArrayPixels(images, np.zeros(images.shape[:3], np.float32))
    turn, scale, shift = Rotation.from_euler("xyz", [0.3, 1.0, -0.4]).as_matrix(), 1000.0, np.array([1e7, 2e6, -3e6])

    def moved(poses):
        poses[:, :3, :3], poses[:, :3, 3] = turn @ poses[:, :3, :3], scale * poses[:, :3, 3] @ turn.T + shift
        return poses

    spoiled = dataclasses.replace(with_poses(wrong, moved(wrong.camtoworlds)), pixels=blind)
    there, here = adjust_poses(spoiled, CONTEXT).capture.camtoworlds, moved(adjusted.capture.camtoworlds)
    np.testing.assert_allclose(there[:, :3, :3], here[:, :3, :3], atol=1e-5)
    np.testing.assert_allclose(there[:, :3, 3], here[:, :3, 3], atol=0.05)


def test_a_capture_without_matches_keeps_its_poses(exact):
    flat = ArrayPixels(np.full((NUM, HEIGHT, WIDTH, 3), 0.5, np.float32), np.zeros((NUM, HEIGHT, WIDTH), np.float32))
    bare = dataclasses.replace(exact, pixels=flat)
    found = adjust_poses(bare)
    assert found.capture is bare and "not adjusted" in found.reason
    assert adjust_poses(exact, [3]).capture is exact
