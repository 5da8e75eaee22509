"""Decoding and resizing of images and depth maps."""

import dataclasses
import struct

import numpy as np
import pytest
from PIL import Image
from PIL.PngImagePlugin import PngImageFile

from ssplat_jax.data.images import image_flags
from tests.badinputs.cases import HEIGHT, WIDTH, another, depth_map, opened
from tests.data.capture_fixture import smooth_capture

EIGHT_BITS = 0.5 / 255


def test_depth_is_meters_from_millimeters_of_any_resolution_and_zero_is_unknown(tmp_path):
    stored = np.tile(100 * np.arange(WIDTH // 2), (HEIGHT // 2, 1))
    stored[0, -1] = 65535
    capture = opened(tmp_path, depth_map(2, stored))
    depth = capture.depth(2)
    assert capture.depth(1) is None and depth.shape == (HEIGHT, WIDTH)
    np.testing.assert_allclose(depth[3, :6], [0, 0, 0.1, 0.1, 0.2, 0.2], rtol=1e-6)
    assert depth[0, -1] == pytest.approx(65.535)


def packed(value):
    """A TIFF by hand: gray of 12 bits, two pixels in three bytes."""
    pixels = (value << 12 | value).to_bytes(3, "big") * (WIDTH * HEIGHT // 2)
    tags = ((256, WIDTH), (257, HEIGHT), (258, 12), (259, 1), (262, 1), (273, 8), (278, HEIGHT), (279, len(pixels)))
    table = b"".join(struct.pack("<HHII", tag, 4, 1, number) for tag, number in tags)
    return struct.pack("<2sHI", b"II", 42, 8 + len(pixels)) + pixels + struct.pack("<H", len(tags)) + table + bytes(4)


GRAY, SIZE = (153, 153, 153), (WIDTH, HEIGHT)
KINDS = {
    **{mode: Image.new("RGB", SIZE, GRAY).convert(mode).save for mode in ("RGB", "L", "P", "CMYK")},
    "composited over black": Image.new("RGBA", SIZE, (255, 255, 255, 153)).save,
    "16 bits": Image.fromarray(np.full((HEIGHT, WIDTH), 39321, np.uint16)).save,
    "12 bits": lambda file: file.write_bytes(packed(2457)),
    "1 bit": Image.new("1", SIZE, 1).save,
}


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_image_becomes_rgb(tmp_path, kind):
    """A uniform gray of 60 %; one bit is black or white."""
    image = opened(tmp_path, another(2, "2.tif", KINDS[kind])).image(2)
    assert image.shape == (HEIGHT, WIDTH, 3) and image.dtype == np.float32
    np.testing.assert_allclose(image, 1.0 if kind == "1 bit" else 0.6, atol=3 * EIGHT_BITS)


def test_flags_of_an_image_are_read_without_decoding_it(tmp_path, monkeypatch):
    decoded = []
    Image.new("RGB", (WIDTH, HEIGHT)).save(tmp_path / "a.png")
    monkeypatch.setattr(PngImageFile, "load", lambda image: decoded.append(image))
    assert image_flags(tmp_path / "a.png") == (False, False) and not decoded


@pytest.mark.parametrize("size", [(64, 48), (32, 24), (32, 32), (24, 48), (100, 20), (63, 47), (128, 96)])
def test_a_point_moves_to_where_its_color_moves(size):
    """The image holds its own pixel coordinates, so pixels must agree with the intrinsics."""
    capture = smooth_capture()
    small = dataclasses.replace(capture, width=size[0], height=size[1])
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
    assert depth.shape == image.shape[:2]
    np.testing.assert_allclose(depth, 1 + stored[..., 0] / 64, rtol=0, atol=0.51 / 64 * (1 + 1e-5))
