"""The recipes of docs/extending.md: performed where no edit is needed, and their lists of places are complete."""

import dataclasses
import json
import re
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

import ssplat_jax as ss
from ssplat_jax.commands import main as command_line
from ssplat_jax.commands import measure_commands
from ssplat_jax.data import open_capture as captures
from ssplat_jax.data.readers.frame_list import FrameList, Intrinsics, Reader
from tests.docs.pages import ROOT, tables

PAGE = ROOT / "docs" / "extending.md"
RECIPES = dict(
    (part.split("\n", 1)[0].strip(), part.split("\n", 1)[1])
    for part in re.split(r"^## ", PAGE.read_text(), flags=re.MULTILINE)[1:]
)


def places(recipe: str) -> list[tuple[str, str]]:
    """(file, symbol) of the rows of a recipe; the symbol of a place that is yet to be written is `new`."""
    (table,) = tables(RECIPES[recipe])
    return [(file.strip("`"), symbol.strip("`")) for file, symbol, _ in table[1:]]


def defines(source: str, symbol: str) -> bool:
    """True if a source defines every part of `name` or `Class.name`."""
    parts = symbol.split(".")
    return all(re.search(rf"^ *(?:(?:def|class) {part}\b|{part}(?::| =))", source, re.MULTILINE) for part in parts)


@pytest.mark.parametrize("recipe", RECIPES)
def test_files_and_symbols_of_recipes_exist(recipe):
    for file, symbol in places(recipe):
        path = ROOT / file
        if symbol == "new" and "mine" in file:
            assert path.parent.is_dir() or path.parent.parent.is_dir(), file
        elif symbol == "new" or path.suffix != ".py":
            assert path.is_file(), file
            assert path.suffix == ".py" or symbol == "new" or symbol in path.read_text(), symbol
        else:
            assert defines(path.read_text(), symbol), f"{file}: {symbol}"


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


# -- a command --------------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Greet:
    """Print a greeting.

    Example: ssplat greet --name world
    """

    name: str = "world"
    """Whom to greet."""

    def run(self) -> int:
        print(f"hello {self.name}")
        return 0


def test_an_added_command_runs(monkeypatch, capsys):
    monkeypatch.setitem(command_line.COMMANDS, "greet", Greet)
    with pytest.raises(SystemExit) as stop:
        command_line.main(["greet", "--name", "reader"])
    assert not stop.value.code
    assert capsys.readouterr().out == "hello reader\n"


def test_an_experiment_of_another_package_is_found(monkeypatch, tmp_path, capsys):
    point = SimpleNamespace(name="toy", load=lambda: lambda captures, out, scale, reporter: f"toy at {scale}")
    monkeypatch.setattr(measure_commands, "entry_points", lambda group: [point])
    with pytest.raises(SystemExit) as stop:
        command_line.main(["experiment", "toy", "--out", str(tmp_path), "--scale", "smoke"])
    assert not stop.value.code
    assert "toy at smoke" in capsys.readouterr().out


# -- a rasterizer output ----------------------------------------------------------------------------------------------


def test_outputs_stand_where_the_recipe_says():
    listed = {file for file, symbol in places("A rasterizer output") if symbol != "new"}
    files = (ROOT / "ssplat_jax" / "rasterizer").glob("*.py")
    own = {f"ssplat_jax/rasterizer/{file.name}" for file in files if re.search("median_(depth|rows)", file.read_text())}
    assert own == {file for file in listed if file.startswith("ssplat_jax/")}
