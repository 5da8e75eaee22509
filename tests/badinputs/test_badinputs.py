"""Bad inputs are refused with one line that names file, field and remedy, before anything is written."""

import json
import random

import pytest

from ssplat_jax.core.errors import InputError
from ssplat_jax.data.open_capture import open_capture
from tests.badinputs.cases import CASES, make_capture, mutant

NUM_MUTANTS = 125  # per file; seeded, so that failures can be repeated


def listing(root):
    return sorted(str(p) for p in root.rglob("*"))


def test_the_unchanged_capture_of_the_cases_is_good(tmp_path):
    capture = open_capture(make_capture(tmp_path / "capture", lambda root, meta: None))
    capture.verify()
    assert len(capture) == 4 and capture.notes == ()


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_bad_capture_is_refused_in_one_line(tmp_path, case):
    root = make_capture(tmp_path / "capture", case.spoil)
    before = listing(tmp_path)
    with pytest.raises(InputError) as caught:
        open_capture(root).verify()
    message = str(caught.value)
    assert "\n" not in message and message.isascii() and len(message) < 600
    assert "wanted" in message and "; " in message  # the wanted value and the remedy
    for words in case.mentions:
        assert words in message, f"{words!r} is not in {message!r}"
    assert listing(tmp_path) == before


@pytest.mark.parametrize(
    ("path", "words"),
    [
        ("nowhere", "nothing of that name"),
        ("loop", "a link that leads nowhere"),
        ("empty", "an empty folder"),
        ("full", "transforms.json, COLMAP"),
        ("file.txt", "none of these"),
        ("other.json", "frames"),
    ],
)
def test_files_and_folders_without_a_capture_are_refused(tmp_path, path, words):
    (tmp_path / "empty").mkdir()
    (tmp_path / "full").mkdir()
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "full" / "a.txt").write_text("a")
    (tmp_path / "file.txt").write_text("a")
    (tmp_path / "other.json").write_text("{}")
    with pytest.raises(InputError, match=words):
        open_capture(tmp_path / path)


@pytest.mark.parametrize(
    ("spec", "words"),
    [
        ("procedural:room?frame=3", "frame"),
        ("procedural:room?frames=0", "frames"),
        ("procedural:room?frames=3.5", "whole number"),
        ("procedural:room?frames=-3", "whole number"),
        ("procedural:room?seed=99999999999999999999", "seed"),
        ("procedural:room?size=128", "WIDTHxHEIGHT"),
        ("procedural:room?size=0x96", "size"),
        ("procedural:nowhere?frames=1", "nowhere"),
        ("procedural:", "room"),
    ],
)
def test_bad_procedural_spec_is_refused(spec, words):
    with pytest.raises(InputError, match=words):
        open_capture(spec)


@pytest.mark.parametrize("size", [(0, 10), (10, -1), (10, 10**6), (9000, 9000)])
def test_bad_size_is_refused(tmp_path, size):
    with pytest.raises(InputError, match="size"):
        open_capture(make_capture(tmp_path / "capture", lambda root, meta: None), size=size)


@pytest.mark.parametrize("name", ["transforms.json", "images/2.jpg", "images/2.png", "d.png"])
def test_mutants_are_read_or_refused_and_never_crash(tmp_path, name):
    def with_other_files(root, meta):
        from PIL import Image

        with Image.open(root / "images" / "2.jpg") as image:
            image.save(root / "images" / "2.png")
        Image.new("I;16", image.size, 900).save(root / "d.png")
        meta["frames"][2]["depth_file_path"] = "d.png"
        if name == "images/2.png":
            meta["frames"][2]["file_path"] = name

    root = make_capture(tmp_path / "capture", with_other_files)
    good = (root / name).read_bytes()
    rng = random.Random(name)
    refused = 0
    for _ in range(NUM_MUTANTS):
        (root / name).write_bytes(mutant(good, rng))
        try:
            capture = open_capture(root)
            capture.verify()
            for i in range(len(capture)):
                capture.image(i), capture.depth(i)
        except InputError as error:
            assert "\n" not in str(error)
            refused += 1
    assert refused > NUM_MUTANTS // 20  # enough mutants reach the checks


def test_messages_have_no_control_characters(tmp_path):
    root = make_capture(tmp_path / "capture", lambda root, meta: meta["frames"][2].update(file_path="\x1b[31m\r\n"))
    with pytest.raises(InputError) as caught:
        open_capture(root)
    assert all(c.isprintable() for c in str(caught.value))
    assert json.loads((root / "transforms.json").read_text())["frames"][2]["file_path"] == "\x1b[31m\r\n"


def test_a_link_to_nothing_is_called_one(tmp_path):
    def dangle(root, meta):
        (root / "images" / "2.jpg").unlink()
        (root / "images" / "2.jpg").symlink_to("nowhere.jpg")

    with pytest.raises(InputError, match="a link to a file that does not exist"):
        open_capture(make_capture(tmp_path / "capture", dangle))
