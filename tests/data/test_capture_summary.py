"""Summaries of captures: facts, and warnings that name a remedy."""

import json

import numpy as np
import pytest

from ssplat_jax.config import StreamConfig
from ssplat_jax.data.capture_summary import summarize
from tests.data.planes_fixture import two_planes


def test_summaries_agree_with_the_stream_frame():
    capture, config = two_planes(8, 0.2), StreamConfig()
    summary = summarize(capture, config)
    assert (summary.num_frames, summary.num_depth_maps, summary.size) == (8, 8, (160, 120))
    np.testing.assert_allclose([summary.path_length, summary.extent, summary.median_step], [1.4, 1.4, 0.2])
    np.testing.assert_allclose(summary.fov_degrees[0], 2 * np.degrees(np.arctan(80 / 140)))
    frame = capture.stream_frame(config)
    assert (summary.scene_scale, summary.near, summary.far) == (frame.scale, frame.near, frame.far)
    np.testing.assert_allclose(summary.voxel_in_capture_units * summary.scene_scale, config.memory.voxel_size)
    assert summary.warnings == ()
    assert json.loads(json.dumps(summary.to_dict()))["size"] == [160, 120]


@pytest.mark.parametrize(
    ("capture", "words"),
    [
        (lambda: two_planes(6, 0.005), "--stride"),
        (lambda: two_planes(3, 0.0), "stand in one place"),
        (lambda: two_planes(1, 0.0), "One frame"),
    ],
)
def test_warnings_name_a_remedy(capture, words):
    warnings = summarize(capture(), StreamConfig()).warnings
    assert any(words in warning for warning in warnings), warnings


def test_a_jump_in_the_stream_is_reported():
    capture = two_planes(8, 0.1)
    for frame in capture.frames[5:]:
        frame.camtoworld[0, 3] += 10.0
    assert any("jump" in w and "frames 4 and 5" in w for w in summarize(capture, StreamConfig()).warnings)
