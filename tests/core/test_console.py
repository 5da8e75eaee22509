"""What the terminal says while a command works: compiling, how long it takes, what to do next."""

import io
import types

import pytest
from rich.console import Console

from ssplat_jax.commands import main as command_line
from ssplat_jax.core.console import WAITING, Reporter


def test_a_bar_says_compiling_until_its_first_step():
    reporter, shown = Reporter(), io.StringIO()
    reporter.console = Console(file=shown, force_terminal=True, width=100)
    with reporter.progress("streaming", 8) as advance:
        assert WAITING in shown.getvalue()
        advance(4, WAITING)  # a run that continues
        shown.truncate(0)
        advance(8)
    assert "8/8" in shown.getvalue() and WAITING not in shown.getvalue().split("8/8")[-1]


def run(*arguments) -> None:
    with pytest.raises(SystemExit) as stopped:
        command_line.main(list(arguments))
    assert stopped.value.code == 0


@pytest.mark.parametrize("quiet", [False, True])
def test_demo_says_how_long_it_takes_and_what_is_next(quiet, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("ssplat_jax.runs.demo.run_demo", lambda *_: {})
    run("demo", "--out", str(tmp_path), *["--quiet"] * quiet)
    captured = capsys.readouterr()
    assert captured.out.startswith(f"wrote {tmp_path}/scene.ply") and captured.out.count("\n") == 1
    if quiet:
        assert captured.err == ""
    else:
        first, last = captured.err.splitlines()
        assert "minutes on two cores" in first and f"`ssplat view {tmp_path}`" in last


def test_train_says_how_long_it_takes_and_what_is_next(tmp_path, monkeypatch, capsys):
    finished = types.SimpleNamespace(interrupted=None, step=1700, params={})
    monkeypatch.setattr("ssplat_jax.training.loop.train", lambda *_, **__: finished)
    monkeypatch.setattr("ssplat_jax.storage.weights.save_weights", lambda *_: None)
    run("train", "--out", str(tmp_path), "--scale-steps", "0.5")
    errors = capsys.readouterr().err
    assert errors.startswith("1700 steps, about 38 minutes on two cores; Ctrl-C saves them")
    assert f"next: `ssplat run CAPTURE --weights {tmp_path}/weights.npz" in errors
