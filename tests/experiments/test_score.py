"""Renders of another method: scored as they are, against the split they name."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from ssplat_experiments.score import run

from ssplat_jax.core.console import Reporter
from ssplat_jax.core.errors import InputError
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.data.split import Split, interleaved_split
from tests.commands.command_fixture import make_capture

ROOM = "procedural:room?frames=8&size=32x24"
QUIET = Reporter(quiet=True)


def write_renders(folder, room, split, gain=1.0):
    """The targets of a split, darker than they are by a gain; names have six digits, of darker ones five."""
    folder.mkdir(parents=True)
    (folder / "split.json").write_text(split.to_json())
    for i in split.targets:
        name = f"{i:06d}.png" if gain == 1.0 else f"{i:05d}.png"
        Image.fromarray((room.image(i) * gain * 255).round().astype(np.uint8)).save(folder / name)


def test_renders_are_scored_as_they_are(tmp_path):
    room, split = open_capture(ROOM), Split("index", (0, 2, 5), (1, 3, 7))
    write_renders(tmp_path / "theirs", room, split, 0.9)
    run(Path(ROOM), tmp_path / "out", "smoke", QUIET, renders=tmp_path / "theirs")
    frames, theirs = sorted((tmp_path / "theirs").glob("*.png")), tmp_path / "by_place"
    theirs.mkdir()
    for place, file in enumerate(frames):  # as Long-LRM and AnySplat name theirs
        file.rename(theirs / f"{place}.png")
    (theirs / "split.json").write_text(split.to_json())
    run(Path(ROOM), tmp_path / "again", "smoke", QUIET, renders=theirs)
    by_place = json.loads((tmp_path / "again" / "table.json").read_text())[0]
    theirs, copy, flat = json.loads((tmp_path / "out" / "table.json").read_text())
    assert by_place["literal_psnr"] == theirs["literal_psnr"]
    wrong = tmp_path / "by_place"
    for names in ({"1": "3", "2": "7"}, {"0": "1", "3": "01", "7": "3"}):  # no image of target 1; two of it
        for old, new in names.items():
            (wrong / f"{old}.png").rename(wrong / f"{new}.png")
        with pytest.raises(InputError, match="target 1,"):
            run(Path(ROOM), tmp_path / "third", "smoke", QUIET, renders=wrong)
    errors = [np.mean((0.1 * room.image(i).astype(np.float64)) ** 2) for i in split.targets]
    assert abs(theirs["literal_psnr"] - np.mean(-10 * np.log10(errors))) < 0.02
    assert theirs["config"] is None and theirs["split"] == split.sha256[:12]
    assert (theirs["method"], copy["method"], flat["method"]) == ("theirs", "copy nearest", "mean color")


def test_scores_are_means_over_views_then_scenes_and_memory_is_the_largest(tmp_path):
    """A method without memory for a scene keeps its row and has no mean."""
    capture, theirs = open_capture(ROOM), tmp_path / "theirs"
    for scene, split in (("a", interleaved_split(8, 1, 5)), ("b", Split("index", (0, 2, 5), (1, 3)))):
        make_capture(tmp_path / "scenes" / scene, num_frames=8, size=(32, 24))
        write_renders(theirs / scene, capture, split)
        (theirs / scene / "metrics.json").write_text(json.dumps({"peak_memory_bytes": 100 + len(split.targets)}))
    run(tmp_path / "scenes", tmp_path / "out", "smoke", QUIET, renders=theirs)
    rows = json.loads((tmp_path / "out" / "table.json").read_text())
    a, b, mean = (row for row in rows if row["method"] == "theirs")
    assert (a["targets"], b["targets"], mean["targets"]) == (1, 2, 3) and mean["peak_memory_bytes"] == 102
    assert mean["literal_psnr"] == pytest.approx((a["literal_psnr"] + b["literal_psnr"]) / 2, abs=1e-3)

    (theirs / "b" / "metrics.json").write_text('{"peak_memory_bytes": "OOM"}')
    run(tmp_path / "scenes", tmp_path / "without", "smoke", QUIET, renders=theirs)
    rows = json.loads((tmp_path / "without" / "table.json").read_text())
    _, b, mean = (row for row in rows if row["method"] == "theirs")
    assert b["peak_memory_bytes"] == mean["peak_memory_bytes"] == "OOM" and "literal_psnr" not in mean
