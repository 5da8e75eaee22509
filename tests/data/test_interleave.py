"""Interleaving of video: which frames share a chunk."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ssplat_jax.config import StreamConfig
from ssplat_jax.data.interleave import MAX_INTERLEAVED_CHUNKS, interleave
from ssplat_jax.data.stream_frame import StreamFrame
from tests.data.planes_fixture import two_planes


def along_a_line(steps):
    x = np.concatenate([[0.0], np.cumsum(steps)])
    return np.stack([x, np.zeros_like(x), np.zeros_like(x)], axis=-1)


def test_slow_video_is_interleaved_to_the_wanted_step():
    order = interleave(along_a_line([0.01] * 23), list(range(100, 124)), chunk_size=4, step=0.03)
    assert order[:12] == [100, 103, 106, 109, 101, 104, 107, 110, 102, 105, 108, 111]
    assert order[12:16] == [112, 115, 118, 121]


@pytest.mark.parametrize("step", [0.0, 0.03, 0.035])
def test_frames_that_step_far_enough_stay_in_order(step):
    assert interleave(along_a_line([0.03] * 19), list(range(20)), 4, step) == list(range(20))


def test_frames_that_do_not_move_stay_in_order():
    assert interleave(np.zeros((9, 3)), list(range(9)), 4, 0.03) == list(range(9))


def test_speed_is_judged_block_by_block():
    """A slow part is interleaved, a fast part after it is not."""
    order = interleave(along_a_line([0.01] * 36 + [0.05] * 35), list(range(72)), 4, 0.03)
    assert order[:4] == [0, 3, 6, 9] and order[-16:] == list(range(56, 72))


def test_a_capture_is_interleaved_unless_frames_are_given():
    capture = two_planes(16, 0.01)  # depths from 2 to 4
    frame = StreamFrame.at_camera(np.eye(4), scale=1.0, near=2.0, far=4.0)
    centers = [np.asarray(chunk.viewmats)[:, 0, 3] for chunk in capture.chunks(StreamConfig(), frame=frame)]
    np.testing.assert_allclose(centers[0], [0, -0.04, -0.08, -0.12], atol=1e-7)  # one block of four chunks
    np.testing.assert_allclose(centers[1], [-0.01, -0.05, -0.09, -0.13], atol=1e-7)
    in_order = next(capture.chunks(StreamConfig(), range(16), frame=frame))
    np.testing.assert_allclose(np.asarray(in_order.viewmats)[:, 0, 3], [0, -0.01, -0.02, -0.03], atol=1e-7)


@settings(max_examples=200, deadline=None)
@given(
    st.lists(st.floats(0, 1), min_size=0, max_size=90),
    st.integers(1, 5),
    st.floats(0, 2),
)
def test_interleaving_is_a_permutation_within_blocks(steps, chunk_size, step):
    n = len(steps) + 1
    order = interleave(along_a_line(steps), list(range(n)), chunk_size, step)
    assert sorted(order) == list(range(n))
    # A frame moves by less than a block.
    assert max(abs(place - frame) for place, frame in enumerate(order)) < chunk_size * MAX_INTERLEAVED_CHUNKS


@pytest.mark.parametrize("units", [2.0**-10, 2.0**10])
def test_the_order_of_a_stream_does_not_change_with_the_units_of_the_capture(units):
    capture, config = two_planes(48, 0.01), StreamConfig()
    poses = [frame.camtoworld.copy() for frame in capture.frames]
    for pose in poses:
        pose[:3, 3] *= units
    frames = tuple(dataclasses.replace(f, camtoworld=p) for f, p in zip(capture.frames, poses, strict=True))
    scaled = dataclasses.replace(capture, frames=frames)
    orders = [
        c.stream_order(config, None, StreamFrame.at_camera(np.eye(4), scale=0.5 / u, near=1.0, far=2.0))
        for c, u in ((capture, 1.0), (scaled, units))
    ]
    assert orders[0] == orders[1] != list(range(48))


def test_units_do_not_matter():
    centers = along_a_line(np.random.default_rng(0).uniform(0, 0.05, 40))
    assert interleave(centers, list(range(41)), 4, 0.03) == interleave(1024 * centers, list(range(41)), 4, 1024 * 0.03)
