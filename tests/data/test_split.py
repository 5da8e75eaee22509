"""Splits into context and targets: exact first indices, disjointness, refusals."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ssplat_jax.config import StreamConfig
from ssplat_jax.core.errors import InputError
from ssplat_jax.data.split import (
    MAX_INTERLEAVED_CHUNKS,
    choose_split,
    interleave,
    interleaved_split,
    paper_split,
    read_index,
    split_of_scene,
)
from ssplat_jax.data.stream_frame import StreamFrame
from tests.data.planes_fixture import two_planes


@settings(max_examples=200, deadline=None)
@given(st.integers(1, 3000), st.integers(1, 20), st.integers(1, 300))
def test_interleaved_laws(num_frames, stride, context):
    try:
        split = interleaved_split(num_frames, stride, context)
    except InputError:
        return
    assert not set(split.context) & set(split.targets)
    assert len(split.context) == context and split.targets
    assert list(split.context) == sorted(split.context)
    assert all(i % stride == 0 and i < num_frames for i in split.context + split.targets)
    assert all(split.context[0] < i < split.context[-1] for i in split.targets)
    assert all(i // stride % 8 == 4 for i in split.targets)


@settings(max_examples=200, deadline=None)
@given(st.integers(1, 3000), st.integers(1, 300), st.integers(1, 64), st.integers(0, 8))
def test_paper_laws(num_frames, context, targets, anchors):
    try:
        split = paper_split(num_frames, context, targets=targets, anchors=anchors)
    except InputError:
        return
    assert not set(split.context) & set(split.targets)
    assert len(split.context) == context == len(set(split.context))
    assert {0, num_frames - 1} <= set(split.targets) or targets == 1


@pytest.mark.parametrize("protocol", ["interleaved", "paper"])
@pytest.mark.parametrize("num_frames", [6, 12, 24, 72, 73, 146, 366, 3000])
def test_a_capture_of_any_length_has_a_split(protocol, num_frames):
    split = choose_split(protocol, num_frames, None, None)
    assert 1 <= len(split.context) <= 64 and len(split.targets) >= 1
    assert len(split.context) + len(split.targets) >= min(73, num_frames)  # of a short capture every frame
    if protocol == "interleaved":
        assert split.context[-1] >= 0.5 * num_frames - 1  # the context reaches over most of the trajectory


def test_the_scannet_protocol_is_the_papers():
    split = choose_split("scannet", 2000, None, 24)
    assert split.protocol == "scannet" and split.keeps_order
    paper = paper_split(2000, 24, targets=64, anchors=8, thin_to=1088)
    assert (split.context, split.targets) == (paper.context, paper.targets)
    assert split.context[:8] != tuple(sorted(split.context))[:8]  # the anchors come first
    assert not choose_split("paper", 2000, None, 24).keeps_order
    exact = choose_split("scannet", 64 + 24, None, 24)  # a short scene is not thinned
    assert len(exact.targets) == 64 and sorted(exact.context + exact.targets) == list(range(88))
    with pytest.raises(InputError, match=r"wanted 64 targets and 24 other frames, got 87 frames"):
        choose_split("scannet", 87, None, 24)


# -- order -----------------------------------------------------------------------------------------------------------


def along_a_line(steps):
    x = np.concatenate([[0.0], np.cumsum(steps)])
    return np.stack([x, np.zeros_like(x), np.zeros_like(x)], axis=-1)


@pytest.mark.parametrize("num_chunks", [1, 2, 3, 8, 30, MAX_INTERLEAVED_CHUNKS])
def test_views_of_a_chunk_are_as_far_apart_as_asked_however_slow_the_video(num_chunks):
    centers = along_a_line([0.03 / num_chunks] * (8 * num_chunks - 1))
    chunks = centers[interleave(centers, list(range(8 * num_chunks)), 4, 0.03), 0].reshape(-1, 4)
    np.testing.assert_allclose(np.diff(chunks), 0.03)


def test_a_capture_is_interleaved_unless_frames_are_given():
    capture = two_planes(16, 0.01)  # depths from 2 to 4
    frame = StreamFrame.at_camera(np.eye(4), scale=1.0, near=2.0, far=4.0)
    centers = [np.asarray(chunk.viewmats)[:, 0, 3] for chunk in capture.chunks(StreamConfig(), stream_frame=frame)]
    np.testing.assert_allclose(centers[0], [0, -0.04, -0.08, -0.12], atol=1e-7)  # one block of four chunks
    np.testing.assert_allclose(centers[1], [-0.01, -0.05, -0.09, -0.13], atol=1e-7)
    in_order = next(capture.chunks(StreamConfig(), range(16), stream_frame=frame))
    np.testing.assert_allclose(np.asarray(in_order.viewmats)[:, 0, 3], [0, -0.01, -0.02, -0.03], atol=1e-7)


@settings(max_examples=200, deadline=None)
@given(st.lists(st.floats(0, 1), min_size=0, max_size=90), st.integers(1, 5), st.floats(0, 2))
def test_interleaving_is_a_permutation_within_blocks(steps, chunk_size, step):
    n = len(steps) + 1
    order = interleave(along_a_line(steps), list(range(n)), chunk_size, step)
    assert sorted(order) == list(range(n))
    # A frame moves by less than a block.
    assert max(abs(place - frame) for place, frame in enumerate(order)) < chunk_size * MAX_INTERLEAVED_CHUNKS


# -- index files ------------------------------------------------------------------------------------------------------

PUBLISHED = {
    "1214f2a11a9fc1ed": {"context": [36, 87], "target": [46, 58, 82], "overlap": 0.63},
    "ab4e6e7a0ac4e2cd": None,
    "0a2f30e1a5b0c3fe": {"context": [0, 30, 15], "target": [20, 4]},
}


def written(tmp_path, value):
    path = tmp_path / "evaluation_index.json"
    path.write_text(json.dumps(value))
    return path


def test_a_published_index_is_read_in_its_order(tmp_path):
    index, notes = read_index(written(tmp_path, PUBLISHED))
    assert list(index) == list(PUBLISHED) and index["ab4e6e7a0ac4e2cd"] is None and notes == ()
    split = split_of_scene(index, "0a2f30e1a5b0c3fe", 31)
    assert split.context == (0, 30, 15) and split.targets == (20, 4) and split.keeps_order


def test_targets_that_are_streamed_are_left_out_and_counted(tmp_path):
    index, (note,) = read_index(written(tmp_path, {"video": {"context": [0, 4], "target": [0, 1, 2, 3, 4]}}))
    assert index["video"].targets == (1, 2, 3)
    assert "2 of 5 targets are context frames too" in note


WRONG = {
    "a scene at least": ({},),
    "object": ([], {"a": []}),
    "target": ({"a": {"context": [0]}}, {"a": {"context": [0, 1], "target": [1]}}),
    "context": tuple({"a": {"context": context, "target": [1]}} for context in ([], [0.5], [True], [-1], [0, 0])),
}


@pytest.mark.parametrize(("value", "words"), [(value, words) for words, values in WRONG.items() for value in values])
def test_a_wrong_index_is_refused_by_its_field(value, words, tmp_path):
    with pytest.raises(InputError, match=words):
        read_index(written(tmp_path, value))


def test_a_scene_that_cannot_be_scored_is_refused(tmp_path):
    index, _ = read_index(written(tmp_path, PUBLISHED))
    for scene, num_frames in (("room", 100), ("ab4e6e7a0ac4e2cd", 100), ("1214f2a11a9fc1ed", 87)):
        with pytest.raises(InputError):
            split_of_scene(index, scene, num_frames)


@pytest.mark.parametrize("units", [2.0**-10, 2.0**10])
def test_the_order_of_a_stream_does_not_change_with_the_units_of_the_capture(units):
    config, capture, scaled = StreamConfig(), two_planes(48, 0.01), two_planes(48, 0.01, units=units)
    orders = [
        c.stream_order(config, None, StreamFrame.at_camera(np.eye(4), scale=0.5 / u, near=1.0, far=2.0))
        for c, u in ((capture, 1.0), (scaled, units))
    ]
    assert orders[0] == orders[1] != list(range(48))
