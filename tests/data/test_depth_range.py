"""Depth statistics: accurate on known scenes, robust in hard cases, independent of frames that are not given."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ssplat_jax.config import StreamConfig
from ssplat_jax.data import depth_range
from ssplat_jax.data.capture_summary import summarize
from ssplat_jax.data.depth_range import DepthStatistics, estimate_depths, stream_scale
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.data.posed_image import MAX_COORDINATE
from ssplat_jax.data.sparse_matches import CommonPoints
from ssplat_jax.data.split import interleaved_split
from tests.data.planes_fixture import two_planes

MEDIAN_TOLERANCE = 1.3  # ratio; keypoints are not distributed like pixels
RANGE_SLACK = 0.001  # share of the pixels that may lie outside [near, far]


def true_depths(capture, indices):
    maps = [capture.depth(i) for i in indices]
    depths = np.concatenate([m.ravel() for m in maps if m is not None])
    return depths[depths > 0]


def assert_right(capture, indices, tolerance, compared):
    depths, truth = estimate_depths(capture, indices), true_depths(capture, compared)
    assert depths.source == "matches"
    assert 1 / tolerance < depths.median / np.median(truth) < tolerance
    _, near, far = stream_scale(depths, StreamConfig().replace(scene_scale=1.0))
    assert np.mean((truth < near) | (truth > far)) <= RANGE_SLACK
    assert far / near < 30  # the range is informative


@pytest.mark.parametrize(
    ("motion", "num_frames", "tolerance"),
    [
        ({"step": 0.002}, 16, 2.0),  # 0.05 % of the depth per frame: more of them show some parallax
        ({"step": 0.03, "spin": 1.0}, 10, MEDIAN_TOLERANCE),
        ({"step": 0.02, "forward": 0.04}, 10, MEDIAN_TOLERANCE),
    ],
    ids=str,
)
def test_depths_of_a_known_scene(motion, num_frames, tolerance):
    assert_right(two_planes(num_frames, **motion), range(num_frames), tolerance, range(num_frames))


@pytest.mark.parametrize(
    "motion", [{"num_frames": 12, "step": 0.06, "board_half": 0.9},
               {"num_frames": 16, "step": 0.3, "start": -2.4, "board_half": 0.56}]
)  # fmt: skip
def test_the_range_holds_a_distant_background_and_what_is_seen_over_short_baselines(motion):
    """A sweep that ends before the background produces floaters, so far includes points with little parallax."""
    capture = two_planes(**motion, wall_at=30.0)
    depths, truth = estimate_depths(capture, range(len(capture))), true_depths(capture, range(len(capture)))
    _, near, far = stream_scale(depths, StreamConfig().replace(scene_scale=1.0))
    assert np.mean(truth < near) < 0.01 and np.mean(truth > far) < 0.01


def test_only_the_given_frames_are_used():
    """The targets of an evaluation must not influence near, far and scale, and a diverged camera is apart if given."""
    capture, used = two_planes(9, 0.05), [0, 1, 2, 3, 5, 6, 7]
    before, truth = estimate_depths(capture, used), np.median(true_depths(capture, range(8)))
    capture.pixels.images[4] = np.nan
    capture.frames[8].camtoworld[:3, 3] = MAX_COORDINATE
    assert estimate_depths(capture, used) == before
    depths = estimate_depths(capture, [*used, 8])
    assert depths.source == "matches" and 1 / MEDIAN_TOLERANCE < depths.median / truth < MEDIAN_TOLERANCE


@pytest.mark.parametrize("center", [[1.0, 2.0, 0.5], [0.0, 0.0, 0.0], [4.2e6, 6.1e5, 4.7e6]])
def test_rounding_of_poses_is_not_motion(center):
    """Inverting matrices moves equal camera centers slightly apart; that is no baseline for measuring depth."""
    capture, rng = two_planes(6, 0.0, spin=3.0), np.random.default_rng(0)
    for frame in capture.frames:
        frame.camtoworld[:3, 3] = np.array(center) * (1 + rng.uniform(-1e-15, 1e-15, 3)) + rng.uniform(-1e-16, 1e-16, 3)
    for used in (range(6), [0]):  # a guess of one
        depths = estimate_depths(capture, used)
        assert (depths.source, depths.median, depths.num_points) == ("baselines", 1.0, 0)
    assert "one place" in summarize(capture, StreamConfig())["warnings"][-1]


@pytest.mark.parametrize(
    ("num_frames", "far_share", "is_widened"), [(16, 0.0, False), (16, 0.3, True), (6, 0.0, True), (6, 0.3, True)]
)
def test_far_is_widened_if_either_pairs_or_parallax_are_few(num_frames, far_share, is_widened, monkeypatch):
    """Few pairs or many points of little parallax, each alone, may have missed the background."""
    n = 40
    is_far = np.arange(n) < far_share * n
    points = CommonPoints(
        inverse_depths=np.where(is_far, 0.49, 0.5),
        parallax=np.where(is_far, 1.0, 4.0),
        weights=np.ones(n),
        close=np.zeros(0),
    )
    monkeypatch.setattr(depth_range, "_best_pair", lambda *_: points)
    depths = estimate_depths(two_planes(num_frames, 0.01), range(num_frames))
    assert depths.source == "matches" and depths.q01 == pytest.approx(2.0)
    assert depths.q99 == pytest.approx(depths.median * (depth_range.MIN_REACH if is_widened else 1.0), rel=0.03)


@settings(max_examples=100, deadline=None)
@given(st.floats(1e-6, 1e6), st.floats(1, 100), st.floats(1, 100))
def test_range_is_bounded_and_scales(median, spread_near, spread_far):
    depths = DepthStatistics(
        q01=median / spread_near,
        median=median,
        q99=median * spread_far,
        num_points=100,
        parallax_degrees=4.0,
        source="matches",
    )
    scale, near, far = stream_scale(depths, StreamConfig())
    np.testing.assert_allclose(scale * median, 2.0, rtol=1e-12)
    assert depth_range.MIN_RANGE * (1 - 1e-9) <= far / near <= depth_range.MAX_RANGE * (1 + 1e-9)
    assert near <= max(scale * depths.q01, 2.0 / 8) * (1 + 1e-9)
    assert near < 2.0 < far
    unit, unit_near, unit_far = stream_scale(depths, StreamConfig().replace(scene_scale=1.0))
    assert unit == 1.0
    np.testing.assert_allclose([unit_near * scale, unit_far * scale], [near, far], rtol=1e-9)


def test_kinect_depths_of_a_hand_held_video(captures):
    """The median is within 35 % of the Kinect's over the same frames, whose depths are inside [near, far]."""
    capture = open_capture(captures / "redkitchen", size=(320, 240))
    used = interleaved_split(len(capture), 5, 8).context
    assert_right(capture, used, 1.35, range(used[0], used[-1] + 1))
