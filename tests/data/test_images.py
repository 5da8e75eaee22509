"""Decoding and resizing of images and depth maps."""

import numpy as np
import pytest
from PIL import Image

from tests.badinputs.cases import HEIGHT, WIDTH, another, depth_map, opened
from tests.data.capture_fixture import resized, smooth_capture

EIGHT_BITS = 0.5 / 255
SIZES = [(64, 48), (32, 24), (32, 32), (24, 48), (100, 20), (63, 47), (128, 96)]


def test_depth_is_meters_from_millimeters_and_zero_is_unknown(tmp_path):
    stored = np.full((HEIGHT, WIDTH), 1500)
    stored[0, :2] = 0, 65535
    capture = opened(tmp_path, depth_map(2, stored))
    depth = capture.depth(2)
    assert capture.depth(1) is None and depth is not None
    np.testing.assert_allclose([depth[0, 0], depth[0, 1], depth[5, 5]], [0, 65.535, 1.5], rtol=1e-6)


@pytest.mark.parametrize("mode", ["RGB", "L", "P", "RGBA", "CMYK", "I;16", "1"])
def test_every_kind_of_image_becomes_rgb(tmp_path, mode):
    """A uniform gray of 60 % is decoded from every mode; transparent pixels are composited over black."""
    value = 153
    if mode == "I;16":
        stored, wanted = Image.fromarray(np.full((HEIGHT, WIDTH), 39321, np.uint16)), 0.6
    elif mode == "RGBA":
        stored, wanted = Image.new("RGBA", (WIDTH, HEIGHT), (value, value, value, 51)), 0.6 * 0.2
    elif mode == "1":
        stored, wanted = Image.new("1", (WIDTH, HEIGHT), 1), 1.0
    else:
        stored, wanted = Image.new("RGB", (WIDTH, HEIGHT), (value,) * 3).convert(mode), 0.6

    image = opened(tmp_path, another(2, "2.tif", stored.save)).image(2)
    assert image.shape == (HEIGHT, WIDTH, 3) and image.dtype == np.float32
    np.testing.assert_allclose(image, wanted, atol=3 * EIGHT_BITS)


@pytest.mark.parametrize("size", SIZES)
def test_a_point_moves_to_where_its_color_moves(size):
    """The image holds its own pixel coordinates, so pixels must agree with the intrinsics."""
    capture = smooth_capture()
    small = resized(capture, *size)
    old, new = capture.K(0), small.K(0)
    image = small.image(0)
    assert image.shape == (size[1], size[0], 3)
    columns, rows = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    rays = np.stack([(columns - new[0, 2]) / new[0, 0], (rows - new[1, 2]) / new[1, 1]], -1)
    stored = rays * [old[0, 0], old[1, 1]] + old[:2, 2]
    inner = (slice(size[1] // 5, -(size[1] // 5)), slice(size[0] // 5, -(size[0] // 5)))  # not the border
    shown = image[..., :2] * [64, 48]
    np.testing.assert_allclose(shown[inner], stored[inner], rtol=0, atol=0.05)  # pixels; half a pixel would be 0.5
    depth = small.depth(0)
    assert depth is not None and depth.shape == image.shape[:2]
    np.testing.assert_allclose(depth, 1 + stored[..., 0] / 64, rtol=0, atol=0.51 / 64 * (1 + 1e-5))


def test_depth_maps_of_another_resolution_are_resized(tmp_path):
    columns = np.tile(100 * np.arange(1, WIDTH // 2 + 1), (HEIGHT // 2, 1))
    depth = opened(tmp_path, depth_map(0, columns)).depth(0)
    assert depth is not None and depth.shape == (HEIGHT, WIDTH)
    np.testing.assert_allclose(depth[3, :6], [0.1, 0.1, 0.2, 0.2, 0.3, 0.3], rtol=1e-6)
