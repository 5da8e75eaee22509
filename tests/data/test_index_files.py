"""Index files: published ones are read as they are, written ones are read again, wrong ones are refused."""

import json

import pytest

from ssplat_jax.core.errors import InputError
from ssplat_jax.data.index_files import index_to_json, read_index, split_of_scene

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


def test_a_written_index_reads_as_the_one_that_was_read(tmp_path):
    index, _ = read_index(written(tmp_path, PUBLISHED))
    assert read_index(written(tmp_path, index_to_json(index)))[0] == index


def test_targets_that_are_streamed_are_left_out_and_counted(tmp_path):
    index, (note,) = read_index(written(tmp_path, {"video": {"context": [0, 4], "target": [0, 1, 2, 3, 4]}}))
    assert index["video"].targets == (1, 2, 3)
    assert "2 of 5 targets are context frames too" in note


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ({}, "a scene at least"),
        ([], "object"),
        ({"a": []}, '"?a"?.*object or null'),
        ({"a": {"context": [0]}}, "target: wanted frame numbers"),
        ({"a": {"context": [], "target": [1]}}, "context: wanted frame numbers"),
        ({"a": {"context": [0.5], "target": [1]}}, "context: wanted frame numbers"),
        ({"a": {"context": [True], "target": [1]}}, "context: wanted frame numbers"),
        ({"a": {"context": [-1], "target": [1]}}, "context: wanted frame numbers"),
        ({"a": {"context": [0, 0], "target": [1]}}, "every frame once"),
        ({"a": {"context": [0, 1], "target": [1]}}, "not streamed"),
    ],
)
def test_a_wrong_index_is_refused_by_its_field(value, words, tmp_path):
    with pytest.raises(InputError, match=words):
        read_index(written(tmp_path, value))


@pytest.mark.parametrize(
    ("scene", "num_frames", "words"),
    [
        ("room", 100, r"wanted the scene .*room.*got 3 others \(1214f2a11a9fc1ed"),
        ("ab4e6e7a0ac4e2cd", 100, "null"),
        ("1214f2a11a9fc1ed", 87, "wanted frame 87, got a capture of 87 frames"),
    ],
)
def test_a_scene_that_cannot_be_scored_is_refused(scene, num_frames, words, tmp_path):
    index, _ = read_index(written(tmp_path, PUBLISHED))
    with pytest.raises(InputError, match=words):
        split_of_scene(index, scene, num_frames)
