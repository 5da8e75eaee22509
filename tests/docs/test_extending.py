"""The five recipes of docs/extending.md: performed where no edit is needed, else their lists of places are complete."""

import ast
import dataclasses
import json
import re
from types import SimpleNamespace
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

import ssplat_jax as ss
from ssplat_jax.commands import main as command_line
from ssplat_jax.commands import options
from ssplat_jax.data import open_capture as captures
from ssplat_jax.data.readers.frame_list import FrameList, Intrinsics, stored_size
from ssplat_jax.model.compact import CompactNetwork
from ssplat_jax.model.network import register_network
from ssplat_jax.network_configs import CompactConfig
from tests.docs.pages import ROOT, tables
from tests.model import small

PAGE = ROOT / "docs" / "extending.md"
RECIPES = dict(
    (part.split("\n", 1)[0].strip(), part.split("\n", 1)[1])
    for part in re.split(r"^## ", PAGE.read_text(), flags=re.MULTILINE)[1:]
)


def places(recipe: str) -> list[tuple[str, str]]:
    """(file, symbol) of the rows of a recipe; the symbol of a place that is yet to be written is `new`."""
    (table,) = tables(RECIPES[recipe])
    return [(file.strip("`"), symbol.strip("`")) for file, symbol, _ in table[1:]]


def names_in(tree: ast.Module) -> set[str]:
    """Names that a module defines, and `Class.name` of those that its classes do."""
    found = set()
    for scope, prefix in [(tree, ""), *((n, f"{n.name}.") for n in tree.body if isinstance(n, ast.ClassDef))]:
        for node in scope.body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                found.add(prefix + node.name)
            targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
            found |= {prefix + target.id for target in targets if isinstance(target, ast.Name)}
    return found


def mentions(word: str, *folders: str) -> set[str]:
    """Python files below the folders that hold a word."""
    files = [file for folder in folders for file in (ROOT / folder).rglob("*.py")]
    found = [file for file in files if re.search(word, file.read_text())]
    return {file.relative_to(ROOT).as_posix() for file in found}


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
            assert symbol in names_in(ast.parse(path.read_text())), f"{file}: {symbol}"


# -- a depth network --------------------------------------------------------------------------------------------------


SHORTEST = {"attention_blocks": 0, "mixer_blocks": 0, "fine_matching": False}
WITHOUT_EXTRAS = {"hpda": False, "cgfi": False, "carving": False, "match_exposure": False}
"""Fewer stages compile faster; none of these matters to the recipe."""


@dataclasses.dataclass(frozen=True)
class ToyConfig(CompactConfig):
    """The compact network's configuration under another name."""

    kind: ClassVar[str] = "toy"


class ToyNetwork(CompactNetwork):
    """A network that is sure of a single depth everywhere."""

    @staticmethod
    def match(params, features, views, config):
        belief = CompactNetwork.match(params, features, views, config)
        probs = jnp.zeros_like(belief.probs).at[..., 3].set(1.0)
        return dataclasses.replace(belief, probs=probs)


@pytest.mark.usefixtures("compiled_plainly", "registered_networks")
def test_a_registered_network_streams():
    register_network(ToyConfig, ToyNetwork())
    narrow = {field.name: getattr(small.CONFIG.network, field.name) for field in dataclasses.fields(CompactConfig)}
    config = small.CONFIG.replace(network=ToyConfig(**narrow | SHORTEST), **WITHOUT_EXTRAS)
    assert ss.StreamConfig.from_dict(config.to_dict()) == config
    model = ss.StreamSplat(config)
    cache, out = jax.jit(model.step)(small.random_params(config), model.init_cache(), small.chunk())
    assert int(cache.num_voxels) > 0
    inside = np.asarray(out.confidences) > 0
    assert np.ptp(np.asarray(out.depths)[inside]) < 1e-4


# -- a capture reader -------------------------------------------------------------------------------------------------


def toy_reader() -> SimpleNamespace:
    """A reader of folders with `toy.json`, which holds the camera's x by image."""

    def read(path):
        facts = json.loads((path / "toy.json").read_text())
        intrinsics = Intrinsics(fx=40.0, fy=40.0, cx=16.0, cy=12.0)
        frames = FrameList(path)
        for name, x in facts.items():
            pose = np.eye(4)
            pose[0, 3] = x
            where = f"{path / 'toy.json'}: {name}"
            frames.add(name, path / name, (pose, 0.0), intrinsics, stored_size(path / name, None, where), where)
        return frames.listing(len(facts), "image")

    return SimpleNamespace(FORMAT="toy", matches=lambda path: (path / "toy.json").is_file(), read=read)


def test_an_added_reader_opens_its_captures(tmp_path, monkeypatch):
    monkeypatch.setattr(captures, "READERS", (*captures.READERS, toy_reader()))
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
    monkeypatch.setattr(options, "entry_points", lambda group: [point])
    with pytest.raises(SystemExit) as stop:
        command_line.main(["experiment", "toy", "--out", str(tmp_path), "--scale", "smoke"])
    assert not stop.value.code
    assert "toy at smoke" in capsys.readouterr().out


# -- a rasterizer output ----------------------------------------------------------------------------------------------


def test_outputs_stand_where_the_recipe_says():
    listed = {file for file, symbol in places("A rasterizer output") if symbol != "new"}
    own = mentions("median_depth|median_rows", "ssplat_jax/rasterizer")
    assert own == {file for file in listed if file.startswith("ssplat_jax/")}
