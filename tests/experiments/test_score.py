"""Renders of another method: scored as they are, against the split they name."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from ssplat_experiments.score import run

from ssplat_jax.commands.experiment_command import Experiment
from ssplat_jax.commands.main import guarded
from ssplat_jax.core.console import Reporter
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.data.split import interleaved_split

ROOM = "procedural:room?frames=8&size=32x24"
QUIET = Reporter(quiet=True)


@pytest.fixture
def renders(tmp_path):
    """The targets of a split, 1/10 darker than they are."""
    room, split = open_capture(ROOM), interleaved_split(8, 1, 5)
    folder = tmp_path / "theirs"
    folder.mkdir()
    (folder / "split.json").write_text(split.to_json())
    for i in split.targets:
        Image.fromarray((np.clip(room.image(i) * 0.9, 0, 1) * 255).round().astype(np.uint8)).save(
            folder / f"{i:05d}.png"
        )
    return folder, room, split


def test_renders_are_scored_as_they_are(renders, tmp_path):
    folder, room, split = renders
    run(Path(ROOM), tmp_path / "out", "smoke", QUIET, renders=folder)
    theirs, copy, flat = json.loads((tmp_path / "out" / "table.json").read_text())
    errors = [np.mean((0.1 * room.image(i).astype(np.float64)) ** 2) for i in split.targets]
    assert abs(theirs["literal_psnr"] - np.mean(-10 * np.log10(errors))) < 0.02
    assert theirs["config"] is None and theirs["split"] == split.sha256[:12]
    assert (theirs["method"], copy["method"], flat["method"]) == ("theirs", "copy nearest", "mean color")


def test_the_memory_of_a_method_is_that_of_its_metrics(renders, tmp_path, capsys):
    folder, _, _ = renders
    command = Experiment("score", out=tmp_path / "out", captures=Path(ROOM), renders=folder, quiet=True)
    (folder / "metrics.json").write_text('{"peak_memory_bytes": 123456}')
    assert guarded(command.run) == 0
    rows = json.loads((tmp_path / "out" / "table.json").read_text())
    assert [row["peak_memory_bytes"] for row in rows] == [123456, None, None]
    bad = {'{"peak_memory_bytes": "much"}': "'much'", '{"peak_memory_bytes": -1}': "-1", "[]": "list"}
    for text, words in bad.items():
        (folder / "metrics.json").write_text(text)
        assert guarded(dataclasses.replace(command, out=tmp_path / "other").run) == 2
        assert words in capsys.readouterr().err


def test_changed_renders_are_not_mixed_with_old_scores(renders, tmp_path, capsys):
    folder, _, split = renders
    command = Experiment("score", out=tmp_path / "out", captures=Path(ROOM), renders=folder, quiet=True)
    assert guarded(command.run) == 0
    Image.new("RGB", (32, 24)).save(folder / f"{split.targets[0]:05d}.png")
    assert guarded(command.run) == 2
    assert "another request" in capsys.readouterr().err


def test_missing_renders_are_named(renders, tmp_path, capsys):
    folder, _, split = renders
    command = Experiment("score", out=tmp_path / "out", captures=Path(ROOM), renders=folder, quiet=True)
    (folder / f"{split.targets[0]:05d}.png").unlink()
    assert guarded(command.run) == 2
    assert f"{split.targets[0]:05d}.png" in capsys.readouterr().err
    (folder / "split.json").unlink()
    assert guarded(command.run) == 2
    assert "split.json" in capsys.readouterr().err
    assert guarded(dataclasses.replace(command, name="cost").run) == 2
    assert "--renders" in capsys.readouterr().err
