"""Bad inputs are refused with one line that names file and field, before anything is written."""

import pytest

from ssplat_jax.core.errors import InputError
from ssplat_jax.data.open_capture import open_capture
from tests.badinputs.cases import CASES, assert_refused, make_capture, read_capture


def test_the_unchanged_capture_of_the_cases_is_good(tmp_path):
    capture = read_capture(make_capture(tmp_path / "capture"))
    assert len(capture) == 4 and capture.notes == ()


@pytest.mark.parametrize(("spoil", "where"), [case[1:] for case in CASES], ids=[name for name, *_ in CASES])
def test_bad_capture_is_refused_in_one_line(tmp_path, spoil, where):
    root = make_capture(tmp_path / "capture", spoil)
    before = sorted(tmp_path.rglob("*"))
    assert_refused(read_capture, root, where, "wanted", "; ")  # and the remedy
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    ("path", "words"),
    [
        ("nowhere", "nothing of that name"),
        ("loop", "a link that leads nowhere"),
        ("empty", "an empty folder"),
        ("full", "transforms.json, COLMAP"),
        ("photos", "images without camera poses; estimate"),
        ("film.mp4", "a video without camera poses; estimate"),
        ("file.txt", "none of these"),
        ("other.json", "frames"),
        ("capture?axes=opengl2", "axes: wanted opencv or opengl"),
        ("capture?axes=opengl&axes=opengl", "twice"),
        ("a" * 300, "wanted a readable file"),
        ("a\0b", "wanted a"),
        ("procedural:room?frame=3", "frame"),
        ("procedural:room?frames=4&frames=9", "twice"),
        ("procedural:room?frames=0", "frames"),
        ("procedural:room?frames=3.5", "whole number"),
        ("procedural:room?seed=99999999999999999999", "seed"),
        ("procedural:room?size=128", "WIDTHxHEIGHT"),
        ("procedural:room?size=0x96", "size"),
        ("procedural:nowhere?frames=1", "nowhere"),
        ("procedural:", "room"),
    ],
)
def test_paths_without_a_capture_are_refused(tmp_path, path, words):
    for folder in ("empty", "full", "photos"):
        (tmp_path / folder).mkdir()
    (tmp_path / "loop").symlink_to("loop")
    for file in ("full/a.txt", "photos/1.heic", "film.mp4", "file.txt", "other.json"):
        (tmp_path / file).write_text("{}")
    with pytest.raises(InputError, match=words):
        open_capture(path if path.startswith("procedural:") else f"{tmp_path}/{path}")


@pytest.mark.parametrize("size", [(0, 10), (10, -1), (10, 10**6), (9000, 9000)])
def test_bad_size_is_refused(tmp_path, size):
    with pytest.raises(InputError, match="size"):
        open_capture(make_capture(tmp_path / "capture"), size=size)
