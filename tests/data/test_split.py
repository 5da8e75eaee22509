"""Splits into context and targets: exact first indices, disjointness, refusals."""

import hashlib
import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ssplat_jax.core.errors import InputError
from ssplat_jax.data.split import Split, choose_split, interleaved_split, paper_split


def test_interleaved_first_indices():
    split = interleaved_split(1000, stride=5, context=64)
    assert split.context[:8] == (0, 5, 10, 15, 25, 30, 35, 40)
    assert split.targets == (20, 60, 100, 140, 180, 220, 260, 300, 340)
    assert len(split.context) == 64 and split.context[-1] == 5 * 72
    assert 5 * 76 not in split.targets  # the next target lies after the last context view


def test_interleaved_of_a_short_orbit():
    split = interleaved_split(50, stride=1, context=40)
    assert split.targets == (4, 12, 20, 28, 36, 44)
    assert len(split.context) == 40 and split.context[-1] == 45


def test_paper_first_indices():
    split = paper_split(300, context=24)
    assert split.targets == (0, 20, 40, 60, 80, 100, 120, 140, 159, 179, 199, 219, 239, 259, 279, 299)
    assert split.context == (*range(1, 20), *range(21, 26))


def test_paper_split_of_scannet():
    split = paper_split(2000, context=24, targets=64, anchors=8, thin_to=1088)
    assert len(split.targets) == 64 and split.targets[0] == 0 and split.targets[-1] == 1999
    anchors, prefix = split.context[:8], split.context[8:]
    assert anchors[-1] > 1990 and list(anchors) == sorted(anchors)
    assert list(prefix) == sorted(prefix) and prefix[-1] < anchors[1]


def test_more_context_extends_a_split():
    """Scores over the number of views compare prefixes of the same order on the same targets."""
    small, large = paper_split(400, context=24, anchors=8), paper_split(400, context=64, anchors=8)
    assert large.context[:24] == small.context and large.targets == small.targets


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


@pytest.mark.parametrize(
    ("split", "words"),
    [
        (lambda: interleaved_split(50, 1, 64), "44 of 50 frames"),
        (lambda: interleaved_split(0, 1, 4), "0 of 0 frames"),
        (lambda: interleaved_split(50, 1, 4), "span a target"),
        (lambda: interleaved_split(50, 0, 4), "stride"),
        (lambda: interleaved_split(50, 1, 0), "context"),
        (lambda: paper_split(30, 24), "14 of 30 frames"),
        (lambda: paper_split(300, 4, anchors=5), "anchors"),
        (lambda: paper_split(300, 4, targets=0), "targets"),
    ],
)
def test_impossible_splits_are_refused(split, words):
    with pytest.raises(InputError, match=words):
        split()


def test_json_and_digest_identify_the_split():
    split = interleaved_split(50, 1, 8)
    assert json.loads(split.to_json()) == {
        "protocol": "interleaved",
        "context": [0, 1, 2, 3, 5, 6, 7, 8],
        "targets": [4],
    }
    assert split.sha256 == hashlib.sha256(split.to_json().encode()).hexdigest()
    assert split.sha256 != interleaved_split(50, 1, 9).sha256


def test_a_split_with_a_shared_frame_cannot_be_made():
    with pytest.raises(ValueError, match="twice"):
        Split(protocol="own", context=(0, 1), targets=(1,))


@pytest.mark.parametrize("protocol", ["interleaved", "paper"])
@pytest.mark.parametrize("num_frames", [6, 12, 24, 72, 73, 146, 366, 3000])
def test_a_capture_of_any_length_has_a_split(protocol, num_frames):
    split = choose_split(protocol, num_frames, None, None)
    assert len(split.context) == min(64, len(split.context)) and len(split.targets) >= 1
    used = len(split.context) + len(split.targets)
    assert used >= min(73, num_frames)  # of a short capture every frame
    if protocol == "interleaved":
        assert split.context[-1] >= 0.5 * num_frames - 1  # the context reaches over most of the trajectory


def test_twenty_four_frames_are_all_used():
    split = choose_split("interleaved", 24, None, None)
    assert split.targets == (4, 12, 20) and len(split.context) == 21


def test_a_given_context_keeps_the_stride_of_one():
    assert choose_split("interleaved", 1000, None, 8) == interleaved_split(1000, 1, 8)


def test_the_scannet_protocol_is_the_papers():
    split = choose_split("scannet", 2000, None, 24)
    assert split.protocol == "scannet" and split.keeps_order
    paper = paper_split(2000, 24, targets=64, anchors=8, thin_to=1088)
    assert (split.context, split.targets) == (paper.context, paper.targets)
    assert split.context[:8] != tuple(sorted(split.context))[:8]  # the anchors come first
    assert not choose_split("paper", 2000, None, 24).keeps_order


def test_a_short_scene_is_not_thinned_and_a_too_short_one_refused():
    exact = choose_split("scannet", 64 + 24, None, 24)
    assert len(exact.targets) == 64 and len(exact.context) == 24
    assert sorted(exact.context + exact.targets) == list(range(88))
    with pytest.raises(InputError, match=r"wanted 64 targets and 24 other frames, got 87 frames.*leave the scene out"):
        choose_split("scannet", 87, None, 24)


def test_five_frames_have_no_target_between_context_views():
    with pytest.raises(InputError, match="at least 6 frames"):
        choose_split("interleaved", 5, None, None)
