"""Summaries of captures: facts, and warnings that name a remedy."""

import dataclasses
import json

import numpy as np

from ssplat_jax.config import StreamConfig
from ssplat_jax.data.capture_summary import order_warnings, summarize
from tests.data.planes_fixture import two_planes


def test_summaries_agree_with_the_stream_frame():
    capture, config = two_planes(8, 0.2), StreamConfig()
    summary = summarize(capture, config)
    assert (summary["num_frames"], summary["num_depth_maps"], summary["size"]) == (8, 8, [160, 120])
    np.testing.assert_allclose([summary["path_length"], summary["extent"], summary["median_step"]], [1.4, 1.4, 0.2])
    np.testing.assert_allclose(summary["fov_degrees"][0], 2 * np.degrees(np.arctan(80 / 140)))
    frame = capture.stream_frame(config)
    assert (summary["scene_scale"], summary["near"], summary["far"]) == (frame.scale, frame.near, frame.far)
    np.testing.assert_allclose(summary["voxel_in_capture_units"] * summary["scene_scale"], config.memory.voxel_size)
    assert summary["warnings"] == []
    assert json.loads(json.dumps(summary))["size"] == [160, 120]


def test_captures_without_parallax_are_warned_of():
    for capture, words in ((two_planes(3, 0.0), "stand in one place"), (two_planes(1, 0.0), "One frame")):
        assert any(words in warning for warning in summarize(capture, StreamConfig())["warnings"])


def test_frames_out_of_the_order_of_a_path_are_found():
    room, mixed = two_planes(24, 0.01, spin=0.2, forward=0.005), np.random.default_rng(0).permutation(24)
    for order, is_path in ((mixed, False), (range(24), True), (range(23, -1, -1), True)):
        warnings = order_warnings(dataclasses.replace(room, frames=tuple(room.frames[i] for i in order)))
        assert ["not in the order of a path" in warning for warning in warnings] == [True] * (not is_path)
