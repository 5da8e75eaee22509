"""The scene does not depend on the position, orientation and unit of a capture's world frame.

The stream frame stands at the first camera: a capture and a copy with all poses moved, turned or scaled give the same
chunks, which are all that a stream sees. What is decoded moves along: tests/data/test_stream_frame.py.
"""

import jax
import numpy as np
import pytest

from ssplat_jax.config import preset
from ssplat_jax.data.open_capture import open_capture
from tests.core.test_rotations import rodrigues
from tests.data.capture_fixture import with_poses

FLOAT32 = 2e-6  # of poses of a few stream units
CONFIG = preset("tiny")
EARTH = np.array([4.2e6, -2.7e6, 4.0e6]) + 0.123  # 6.4e6 from the origin, and no number that float32 could hold
TURN = rodrigues([0.3, -0.8, 0.52], 2.0)
MOTIONS = {  # scale, rotation, translation of the world
    "shifted by 6.4e6": (1.0, np.eye(3), EARTH),
    "turned and shifted by 6.4e6": (1.0, TURN, EARTH),
    "in another unit, turned and shifted": (0.013, TURN, np.array([3.0, -7.0, 2.0])),
}


@pytest.fixture(scope="module")
def capture():
    """Its images are large enough for keypoints, from which the scale is estimated."""
    return open_capture("procedural:room?frames=4&size=160x120")


@pytest.mark.parametrize("name", MOTIONS)
def test_a_moved_world_gives_the_same_chunks(capture, name):
    (scale, rotation, translation), poses = MOTIONS[name], capture.camtoworlds
    poses[:, :3, :3], poses[:, :3, 3] = rotation @ poses[:, :3, :3], scale * poses[:, :3, 3] @ rotation.T + translation
    moved = with_poses(capture, poses)
    here, there = (c.stream_frame(CONFIG) for c in (capture, moved))
    assert scale * there.scale == pytest.approx(here.scale, rel=1e-5)  # small parallax amplifies float64's rounding
    chunks = (c.chunks(CONFIG, range(4), stream_frame=frame) for c, frame in ((capture, here), (moved, there)))
    for wanted, got in zip(*chunks, strict=True):
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=FLOAT32), got, wanted)
