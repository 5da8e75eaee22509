"""What the experiments compute beside what they measure, and how the command line finds them."""

from importlib.metadata import entry_points

import pytest

from experiments.accuracy_vs_time import mark_front
from ssplat_jax.cli import Experiment, guarded


def row(ms, psnr):
    return {"ms_per_view": ms, "psnr": psnr}


def test_the_front_holds_what_nothing_beats_in_both():
    rows = [row(10, 15.0), row(20, 14.0), row(20, 18.0), row(5, 12.0), row(30, 18.0), row(40, 18.5)]
    mark_front(rows)
    for a in rows:
        beaten = any(b["ms_per_view"] <= a["ms_per_view"] and b["psnr"] >= a["psnr"] and b is not a for b in rows)
        assert a["front"] != beaten


def test_every_registered_experiment_can_be_loaded():
    points = entry_points(group="ssplat_jax.experiments")
    assert {"captures", "accuracy_vs_time"} <= {point.name for point in points}
    assert all(callable(point.load()) for point in points)


def test_an_unknown_experiment_is_refused_before_anything_is_written(tmp_path, capsys):
    assert guarded(Experiment("no_such", out=tmp_path / "out").run) == 2
    assert "accuracy_vs_time" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("missing", [None, "empty"])
def test_the_captures_experiment_says_what_it_wanted(missing, tmp_path, capsys):
    folder = None if missing is None else tmp_path / missing
    if folder:
        folder.mkdir()
    assert guarded(Experiment("captures", out=tmp_path / "out", captures=folder, quiet=True).run) == 2
    assert "captures" in capsys.readouterr().err
