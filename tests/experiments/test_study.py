"""The frame of the experiments: cases are kept, guarded by their hash, and every row tells where it comes from."""

import csv

import pytest
from ssplat_experiments.cases import Case
from ssplat_experiments.study import Study, run_study

from ssplat_jax.config import preset
from ssplat_jax.core.console import Reporter
from ssplat_jax.core.errors import InputError

QUIET = Reporter(quiet=True)


class Killed(BaseException):
    """Stands for a signal that nothing catches."""


def counting_study(calls, *, dies_at=None, voxel_size=0.03):
    """Three cases that count their measurements; the measurement of case `dies_at` ends as a kill does."""

    def measure(number):
        calls.append(number)
        if number == dies_at:
            raise Killed
        return [{"number": number, "square": number**2, "peak_bytes": 2**20 * number}]

    def cases(captures, scale):
        config = preset("tiny").replace(voxel_size=voxel_size)
        return [Case(f"case {n}", config, {"n": n, "scale": scale}, lambda n=n: measure(n)) for n in range(3)]

    return Study("counting", "Counts.", cases, findings=lambda rows: [f"{len(rows)} numbers."])


def files_of(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_killed_study_continues_to_the_same_files(tmp_path):
    run_study(counting_study([]), None, tmp_path / "whole", "smoke", QUIET)
    first, second = [], []
    with pytest.raises(Killed):
        run_study(counting_study(first, dies_at=1), None, tmp_path / "killed", "smoke", QUIET)
    run_study(counting_study(second), None, tmp_path / "killed", "smoke", QUIET)
    assert (first, second) == ([0, 1], [1, 2])
    whole, killed = files_of(tmp_path / "whole"), files_of(tmp_path / "killed")
    assert whole.keys() == killed.keys()
    for path in whole:
        if path.parts[0] != "cases":  # a case holds its seconds
            assert whole[path] == killed[path], path


def test_results_of_another_configuration_are_refused(tmp_path):
    run_study(counting_study([]), None, tmp_path, "smoke", QUIET)
    held, calls = files_of(tmp_path), []
    with pytest.raises(InputError, match=r"config\.memory\.voxel_size: 0\.03, wanted now 0\.05"):
        run_study(counting_study(calls, voxel_size=0.05), None, tmp_path, "smoke", QUIET)
    with pytest.raises(InputError, match=r"asked\.scale: 'smoke', wanted now 'cpu'"):
        run_study(counting_study(calls), None, tmp_path, "cpu", QUIET)
    assert calls == [] and files_of(tmp_path) == held


def test_every_row_tells_where_it_comes_from(tmp_path):
    run_study(counting_study([]), None, tmp_path, "smoke", QUIET)
    with (tmp_path / "table.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["square"] for row in rows] == ["0", "1", "4"]
    assert {row["config"] for row in rows} == {preset("tiny").hash}
    assert all(row["machine"] and row["commit"] and row["date"] for row in rows)
    page = (tmp_path / "page.md").read_text()
    assert "| 2 | 4 | 2.0 |" in page and page.count(preset("tiny").hash) == 3 and "3 numbers." in page
