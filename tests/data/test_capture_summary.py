"""Summaries of captures: facts, and warnings that name a remedy."""

import dataclasses
import json
import shutil

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from ssplat_jax.config import StreamConfig
from ssplat_jax.data.capture import ArrayPixels, Capture
from ssplat_jax.data.capture_summary import (
    _depth_map_warnings,
    frame_warnings,
    image_warnings,
    order_warnings,
    summarize,
)
from ssplat_jax.data.depth_range import DepthStatistics
from ssplat_jax.data.open_capture import open_capture
from tests.badinputs.cases import make_capture
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


@pytest.mark.parametrize(
    ("capture", "words"),
    [
        (lambda: two_planes(6, 0.005), "--stride"),
        (lambda: two_planes(3, 0.0), "stand in one place"),
        (lambda: two_planes(1, 0.0), "One frame"),
    ],
)
def test_warnings_name_a_remedy(capture, words):
    warnings = summarize(capture(), StreamConfig())["warnings"]
    assert any(words in warning for warning in warnings), warnings


def test_depth_maps_of_another_unit_are_reported():
    depths = DepthStatistics(1.0, 2.0, 4.0, 100, 12, 5.0, "matches")
    assert _depth_map_warnings(depths, 2.2) == _depth_map_warnings(depths, None) == []
    (warning,) = _depth_map_warnings(depths, 2000.0)
    assert "1e+03 times" in warning and "unit" in warning


# -- frames -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def room() -> Capture:
    return two_planes(24, 0.01, spin=0.2, forward=0.005)


def changed(capture: Capture, images=None, frames=None) -> Capture:
    assert isinstance(capture.pixels, ArrayPixels)
    images = capture.pixels.images if images is None else images
    pixels = ArrayPixels(images=images, depths=np.zeros(images.shape[:3], np.float32))
    return dataclasses.replace(capture, pixels=pixels, frames=capture.frames if frames is None else tuple(frames))


def reordered(capture: Capture, order) -> Capture:
    return changed(capture, capture.pixels.images[list(order)], [capture.frames[i] for i in order])


def test_a_good_capture_has_no_findings(room):
    assert frame_warnings(room) == []


def test_shuffled_frames_are_found(room):
    (warning,) = order_warnings(reordered(room, np.random.default_rng(0).permutation(len(room))))
    assert "not in the order of a path" in warning and "name the images" in warning
    assert order_warnings(reordered(room, range(len(room))[::-1])) == []  # backwards is a path too


def test_a_frame_out_of_order_is_found(room):
    order = [i for i in range(24) if i != 20]
    order.insert(5, 20)
    (warning,) = order_warnings(reordered(room, order))
    assert "frames 5)" in warning and "out of order" in warning


def test_copies_are_found_in_memory_and_in_files(room, tmp_path):
    images = room.pixels.images.copy()
    images[[7, 12]] = images[[6, 3]]
    warnings = [w for w in frame_warnings(changed(room, images)) if "copies" in w]
    assert len(warnings) == 1 and warnings[0].startswith("2 images") and "frames 7, 12)" in warnings[0]
    root = make_capture(tmp_path / "capture")
    shutil.copy(root / "images" / "0.jpg", root / "images" / "3.jpg")
    assert [w for w in frame_warnings(open_capture(root)) if "1 images are copies" in w and "frames 3)" in w]


@pytest.mark.parametrize("i", [0, 11, 23])
def test_a_blurred_image_is_found(i, room):
    images = room.pixels.images.copy()
    images[i] = gaussian_filter(images[i], (2.5, 2.5, 0))
    (warning,) = image_warnings(changed(room, images))
    assert warning.startswith("1 images are blurred") and f"frames {i})" in warning


@pytest.mark.parametrize("gain", [0.6, 1.6])
def test_a_jump_of_exposure_is_found(gain, room):
    images = np.clip(room.pixels.images * 0.6, 0, 1)
    images[10:] *= gain
    (warning,) = image_warnings(changed(room, images))
    assert (
        warning.startswith("1 jumps of exposure")
        and "(after frames 9)" in warning
        and "1.6 times" in warning.replace("1.7", "1.6")
    )
