"""The recipes of docs/extending.md: performed where no edit is needed, and the places of the others exist."""

import json
import re

import numpy as np
from PIL import Image

import ssplat_jax as ss
from ssplat_jax.data import open_capture as captures
from ssplat_jax.data.readers.frame_list import FrameList, Intrinsics, Reader
from tests.docs.pages import ROOT

PAGE = ROOT / "docs" / "extending.md"


def test_places_of_recipes_exist():
    """A file's symbol occurs in it; files of one's own are called `mine`."""
    for file, symbol in re.findall(r"^\| `([^`]+)` \| `?([\w.]+)`? \|", PAGE.read_text(), re.MULTILINE):
        path = ROOT / file
        if "mine" not in file:
            assert symbol == "new" or symbol.split(".")[-1] in path.read_text(), f"{file}: {symbol}"


# -- a capture reader -------------------------------------------------------------------------------------------------


def toy_reader() -> Reader:
    """A reader of folders with `toy.json`, which holds the camera's x by image."""

    def read(path, convention):
        facts = json.loads((path / "toy.json").read_text())
        intrinsics = Intrinsics(fx=40.0, fy=40.0, cx=16.0, cy=12.0)
        frames = FrameList(path, convention)
        for name, x in facts.items():
            pose = np.eye(4)
            pose[0, 3] = x
            frames.add(name, path / name, pose, intrinsics, f"{path / 'toy.json'}: {name}")
        return frames.listing(len(facts), "image")

    return Reader("toy", lambda path: (path / "toy.json").is_file(), read)


def test_an_added_reader_opens_its_captures(tmp_path, monkeypatch):
    monkeypatch.setattr(captures, "CAPTURE_READERS", (*captures.CAPTURE_READERS, toy_reader()))
    for i in range(3):
        Image.new("RGB", (32, 24), (80 * i, 0, 0)).save(tmp_path / f"{i}.png")
    (tmp_path / "toy.json").write_text(json.dumps({f"{i}.png": 0.1 * i for i in range(3)}))
    capture = ss.open_capture(tmp_path)
    assert (capture.format, len(capture), capture.image(2).shape) == ("toy", 3, (24, 32, 3))
    np.testing.assert_allclose(capture.camtoworlds[:, 0, 3], [0.0, 0.1, 0.2])
