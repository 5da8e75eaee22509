"""Captures: digests, cameras and chunks. Refusals are tested in tests/badinputs."""

import dataclasses
import gc
import tracemalloc

import jax
import numpy as np
import pytest

from ssplat_jax.config import StreamConfig
from ssplat_jax.core.cameras import transform_points
from ssplat_jax.core.errors import InputError
from ssplat_jax.data import capture as capture_module
from ssplat_jax.data.capture import KEPT_IMAGES
from ssplat_jax.data.open_capture import open_capture
from tests.badinputs.cases import make_capture
from tests.data.capture_fixture import frame_of, smooth_capture
from tests.data.planes_fixture import two_planes

FLOAT32_PIXELS = 1e-3


def test_points_keep_their_pixel_after_resizing_and_transform():
    capture = dataclasses.replace(smooth_capture(), width=40, height=40)
    frame = frame_of(capture, scale=2.5)
    rng = np.random.default_rng(0)
    for i in range(len(capture)):
        stored, pose = capture.frames[i], capture.frames[i].camtoworld
        in_camera = np.concatenate([rng.uniform(-0.3, 0.3, (20, 2)), rng.uniform(1, 3, (20, 1))], -1)
        pixel = (in_camera @ stored.K.T)[:, :2] / in_camera[:, 2:]
        crop = capture.crop(i)
        np.testing.assert_allclose(  # what is cut away is equal on both sides
            [2 * crop.left + 40 / crop.scale, 2 * crop.top + 40 / crop.scale], [stored.width, stored.height], atol=1e-9
        )
        wanted = (pixel - [crop.left, crop.top]) * crop.scale
        points = frame.points_to_stream(in_camera @ pose[:3, :3].T + pose[:3, 3]).astype(np.float32)
        camera = capture.camera(i, frame)
        seen = np.asarray(transform_points(camera.viewmats, jax.numpy.asarray(points))) @ np.asarray(camera.Ks).T
        np.testing.assert_allclose(seen[:, :2] / seen[:, 2:], wanted, rtol=0, atol=FLOAT32_PIXELS)
        np.testing.assert_allclose(seen[:, 2], 2.5 * in_camera[:, 2], rtol=1e-5)


def test_chunks_hold_the_frames_in_order_and_pad_the_last():
    capture = smooth_capture()
    frame = frame_of(capture)
    used = [5, 0, 1, 3, 2, 4]
    chunks = list(capture.chunks(StreamConfig().replace(chunk_size=4), used, stream_frame=frame))
    assert [chunk.valid.tolist() for chunk in chunks] == [[True] * 4, [True, True, False, False]]
    rows = [(c.images[v], c.viewmats[v], c.Ks[v]) for c in chunks for v in range(4) if c.valid[v]]
    for i, (image, viewmat, K) in zip(used, rows, strict=True):
        camera = capture.camera(i, frame)
        np.testing.assert_array_equal(image, capture.image(i))
        np.testing.assert_array_equal(viewmat, camera.viewmats)
        np.testing.assert_array_equal(K, camera.Ks)
    assert not chunks[1].images[2:].any()
    np.testing.assert_array_equal(chunks[1].viewmats[2:], np.broadcast_to(np.eye(4), (2, 4, 4)))
    np.testing.assert_array_equal(chunks[1].Ks[2:], np.broadcast_to(capture.K(2).astype(np.float32), (2, 3, 3)))
    assert all(float(chunk.near) == 0.5 and float(chunk.far) == 8.0 for chunk in chunks)


def test_an_image_is_decoded_once_for_depth_range_and_stream(tmp_path, monkeypatch):
    decoded, decode = [], capture_module.decode_image
    monkeypatch.setattr(capture_module, "decode_image", lambda path, size: decoded.append(path) or decode(path, size))
    capture = open_capture(make_capture(tmp_path / "c"), size=(32, 24))
    assert sum(int(chunk.valid.sum()) for chunk in capture.chunks(StreamConfig())) == 4
    assert sorted(decoded) == [frame.path for frame in capture.frames]


def test_a_camera_without_a_frame_is_in_the_frame_of_the_capture():
    capture = two_planes(3, 0.2, spin=10.0, forward=0.1)
    offset = (1.0, -2.0, 0.5)
    for i in range(3):
        camera, relative = capture.camera(i), capture.camera(i, offset=offset)
        np.testing.assert_allclose(camera.viewmats, np.linalg.inv(capture.frames[i].camtoworld), atol=1e-6)
        np.testing.assert_array_equal(camera.Ks, capture.K(i).astype(np.float32))
        np.testing.assert_allclose(relative.centers + np.array(offset), capture.frames[i].center, atol=1e-6)
        assert (camera.width, camera.height) == (capture.width, capture.height)
    for i in (3, -1):
        with pytest.raises(InputError, match=r"frame numbers in \[0, 2\]"):
            capture.camera(i)


def test_names_that_are_not_utf8_have_digests():
    """Names on Linux are bytes; Python keeps the others as surrogates."""
    capture = smooth_capture(1)
    named = lambda name: dataclasses.replace(capture, frames=(dataclasses.replace(capture.frames[0], name=name),))  # noqa: E731
    assert len({named(name).digest([0]) for name in ("caf\udce9.jpg", "caf\udcea.jpg", "caf.jpg")}) == 3


def test_memory_does_not_grow_with_the_number_of_images(tmp_path):
    """A stream keeps facts alone of an image that it has passed, beside a bounded number of images."""
    num = KEPT_IMAGES + 200
    capture, held = open_capture(make_capture(tmp_path / "c", num_frames=num), size=(64, 48)), []
    frame = frame_of(capture)
    tracemalloc.start()
    for number, _ in enumerate(capture.chunks(StreamConfig(), range(num), stream_frame=frame), start=1):
        if 4 * number in (KEPT_IMAGES + 40, num):
            gc.collect()
            held.append(tracemalloc.get_traced_memory()[0])
    tracemalloc.stop()
    assert (held[1] - held[0]) / 160 < 500, held  # bytes; an image has 36,864
