"""Summaries of captures: facts, and warnings that name a remedy."""

import dataclasses
import json

import numpy as np
import pytest

from ssplat_jax.config import StreamConfig
from ssplat_jax.data.capture_summary import UNITS, Summary, _depth_map_warnings, _warnings, summarize
from ssplat_jax.data.depth_range import DepthStatistics
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


def test_depth_maps_are_measured_and_named():
    capture = two_planes(8, 0.2)
    summary = summarize(capture, StreamConfig())
    known = np.concatenate([depth[depth > 0] for i in range(8) if (depth := capture.depth(i)) is not None])
    assert summary.depth_maps_median == pytest.approx(float(np.median(known)))
    assert summary.num_depth_maps == 8 and "num_depth_maps" in UNITS


def test_depth_maps_of_another_unit_are_reported():
    depths = DepthStatistics(1.0, 2.0, 4.0, 100, 12, 5.0, "matches")
    assert _depth_map_warnings(depths, 2.2) == _depth_map_warnings(depths, None) == []
    (warning,) = _depth_map_warnings(depths, 2000.0)
    assert "1e+03 times" in warning and "unit" in warning


def test_a_small_median_parallax_is_reported():
    capture, steps = two_planes(8, 0.2), np.full(7, 0.2)
    for parallax, wanted in ((1.1, "Little parallax: 1.1 degrees"), (4.0, None)):
        found = _warnings(capture, DepthStatistics(1.0, 2.0, 4.0, 100, 12, parallax, "matches"), steps)
        assert [w.startswith(wanted) for w in found] == [True] if wanted else found == []


def test_every_length_of_a_summary_has_its_unit():
    names = {field.name for field in dataclasses.fields(Summary)}
    assert set(UNITS) <= names
    assert all("stream units" in UNITS[name] for name in ("near", "far", "scene_scale"))
    calls = []
    summarize(two_planes(8, 0.2), StreamConfig(), calls.append)
    assert calls == list(range(8))
