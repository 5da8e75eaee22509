"""The command line: help at once, clear refusals, nothing half-written. Heavy commands are run small."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ssplat_jax.commands.main import COMMANDS
from ssplat_jax.config import preset
from ssplat_jax.core.errors import InputError
from ssplat_jax.runs.stream_commands import Run, apply_changes
from ssplat_jax.scene_files.formats import load_ply, save_ply
from ssplat_jax.storage.weights import as_published, load_weights, published_tensors
from tests.commands.command_fixture import edit, make_capture, run
from tests.model.resplat_fixture import named_tensor
from tests.scene_files import scene_fixture

ALL_HELP = """
import sys
from ssplat_jax.commands.main import COMMANDS, main
for words in ((), *((name,) for name in COMMANDS)):
    try:
        main([*words, "--help"])
    except SystemExit as stop:
        assert not stop.code
assert "jax" not in sys.modules, "help imported jax"
"""
ROOM = "procedural:room?frames=12&size=32x24"


def test_help_does_not_import_jax_and_shows_examples():
    done = subprocess.run([sys.executable, "-c", ALL_HELP], capture_output=True, text=True, check=True)
    for name in COMMANDS:
        assert f"Example: ssplat {name}" in done.stdout


def test_output_that_nobody_reads_ends_a_command_quietly():
    command = [sys.executable, "-m", "ssplat_jax.commands.start", "--help"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stderr is not None
        process.stdout.close()
        assert (process.stderr.read(), process.wait()) == (b"", 128 + signal.SIGPIPE)


def truncate(capture):
    path = capture / "images" / "2.png"
    path.write_bytes(path.read_bytes()[:200])


@pytest.mark.parametrize(("spoil", "named"), [(truncate, "2.png"), (edit("fl_x", 0.0), "fl_x")])  # tests/badinputs: all
@pytest.mark.parametrize("command", [("run",), ("eval", "--context", "5")])
def test_bad_capture_is_one_line_exit_2_and_nothing_written(spoil, named, command, tmp_path, capsys):
    capture, out = make_capture(tmp_path / "capture"), tmp_path / "out"
    spoil(capture)
    assert run(command[0], capture, *command[1:], "--out", out) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert named in line and not out.exists()


def test_results_among_the_captures_own_images_are_refused(tmp_path, capsys):
    """A run overwrites and clears files of its folder, so its images must not lie there."""
    capture = make_capture(tmp_path / "views")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.*")}
    for out in (tmp_path, capture / "images" / "sub"):
        assert run("run", capture, "--overwrite", "--out", out) == 2
        assert "--out" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.*")} == before


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("inspect", "no/such/folder"), "no/such/folder"),
        (("eval", "procedural:room", "--context", "5", "--size", "huge", "--out", "x"), "--size"),
        (("eval", "procedural:room", "--context", "8", "--set", "voxel_size=-1", "--out", "x"), "voxel_size"),
        (("train", "--shares", "0.5", "--out", "x"), "--shares: wanted --captures"),
        (("run", "procedural:room?frames=2&size=32x24", "--stride", "0", "--out", "x"), "--stride"),
        (("export", "no_run", "--to", "x.ply"), "no_run"),
        (("import-weights", "no.pth", "--out", "x.npz"), "no.pth: cannot be read"),
        (("run", "procedural:room", "--weights", "small", "--out", "x"), "none ship with the preset 'small'"),
        (("run", "x", "--out", "y", "--set", "a=1", "--adjust-poses", "--set", "b=2"), "wanted --set once, got it"),
        (("run", "procedural:room", "--causal", "--adjust-poses", "--out", "x"), "--adjust-poses: wanted a stream"),
        (("poses", ".", "--frames", "20", "--out", "x"), "--frames: wanted a video"),
        (("run", ".", "--watch", "--quiet-seconds", "0.1", "--quiet", "--out", "x"), "a frame that can be read"),
        (("run", ".", "--watch", "--axes", "opencv", "--out", "x"), "--watch: wanted transforms"),
        (("eval", ROOM, "--scene", "a", "--out", "x"), "--index beside it"),
        (("eval", ROOM, "--index", "i.json", "--context", "4", "--out", "x"), "--context too"),
    ],
)
def test_bad_values_are_one_line_and_exit_2(arguments, named, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run(*arguments) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if line.strip()]
    assert len(lines) == 1 and named in lines[0]
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("arguments", [("demo",), ("eval", ROOM), ("eval", "scenes", "--index", "index.json"),
                                       ("render", "a.ply", ROOM)])  # fmt: skip
def test_files_of_a_run_are_not_replaced_by_other_commands(arguments, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("out").mkdir()
    Path("out", "state.npz").write_text("of a run")
    save_ply(Path("a.ply"), scene_fixture.scene(0, n=5))
    make_capture(Path("scenes", "wall"), num_frames=3)
    Path("index.json").write_text(json.dumps({"wall": {"context": [0, 2], "target": [1]}}))
    assert run(*arguments, "--out", "out") == 2
    assert "wanted a folder without a run" in capsys.readouterr().err
    assert [file.read_text() for file in Path("out").iterdir()] == ["of a run"]


def test_set_takes_what_the_field_holds():
    for change, value in (("voxel_size=1", 1.0), ("encoder_widths=[16, 32]", (16, 32)), ("carving=false", False)):
        changed = apply_changes(preset("tiny"), (change,)).get(change.partition("=")[0])
        assert changed == value and type(changed) is type(value)


def test_two_values_of_one_field_are_refused():
    for twice in (("voxel_size=0.02", "memory.voxel_size=0.05"), ("voxel_size=0.02", "voxel_size=0.03")):
        with pytest.raises(InputError, match=r"wanted one value of memory\.voxel_size, got voxel_size=0\.02 and"):
            apply_changes(preset("tiny"), twice)
    with pytest.raises(InputError, match=r"one value of stream\.causal"):  # --causal beside --set
        Run("x", Path("y"), set=("causal=false",)).load_model(causal=True)
    assert apply_changes(preset("tiny"), ("causal=true", "stream.causal=true")).stream.causal


@pytest.mark.slow  # compiles a network of 62 million parameters
@pytest.mark.parametrize("name", ["small", "paper"])
def test_imported_weights_stream_a_capture(name, tmp_path, capsys):
    published = [t for t in published_tensors(preset("small")).values() if t is not None]
    tensors = {t.name: named_tensor(t.name, t.shape) for t in published}
    np.savez(tmp_path / "upstream.npz", **tensors)
    checkpoint, file = tmp_path / "upstream.npz", tmp_path / f"{name}.npz"
    assert run("import-weights", checkpoint, "--preset", name, "--out", file) == 0
    assert "701 tensors (0 not used); fresh: HPDA and CGFI" in capsys.readouterr().out
    params, config = load_weights(file)
    assert config == as_published(preset(name))
    assert params["decoder"]["gaussian_head_2"]["kernel"].dtype == np.float32
    theirs = tensors["encoder.gaussian_head.2.weight"]
    np.testing.assert_array_equal(params["decoder"]["gaussian_head_2"]["kernel"], theirs.T)
    capture, out = make_capture(tmp_path / "capture"), tmp_path / "out"
    weights = ("--weights", file, "--set", "min_confidence=0.0", "capacity=32768")
    assert run("run", capture, "--out", out, *weights, "--quiet") == 0
    assert load_ply(out / "scene.ply").num_gaussians > 0


@pytest.mark.parametrize(("name", "value"), [("JAX_PLATFORMS", "cuda"), ("JAX_PLATFORM_NAME", "gpu")])
def test_a_platform_that_jax_lacks_is_one_line(name, value, monkeypatch):
    monkeypatch.delenv("JAX_PLATFORMS", raising=False)
    done = started("weights", "tiny", **{name: value})
    assert done.returncode == 2 and f"{name}={value}: wanted a platform" in done.stderr
    assert done.stderr.count("\n") == 1


def test_settings_for_other_programs_change_nothing(tmp_path):
    """Double precision, ranks that must be equal, and an output that cannot show a name."""
    file, shown = tmp_path / "caf\u0107.ply", tmp_path / "out.spz"
    save_ply(file, scene_fixture.scene(0, n=5))
    capture = make_capture(tmp_path / "wall\u0107", num_frames=2)
    settings = {"JAX_ENABLE_X64": "1", "JAX_NUMPY_RANK_PROMOTION": "raise", "PYTHONIOENCODING": "latin-1"}
    settings |= {"JAX_TRANSFER_GUARD": "disallow", "JAX_DISABLE_JIT": "1"}
    assert started("export", file, "--to", shown, **settings).returncode == 0
    done = started("render", file, capture, "--out", tmp_path / "p\u0107", **settings)
    assert done.returncode == 0 and "wrote 2 pictures to" in done.stdout and "p\\u0107" in done.stdout, done.stderr


def test_an_output_that_is_closed_changes_nothing(tmp_path):
    file = tmp_path / "a.ply"
    save_ply(file, scene_fixture.scene(0, n=5))
    command = f"{sys.executable} -m ssplat_jax.commands.start export {file} --to {tmp_path}/b.spz >&-"
    done = subprocess.run(["sh", "-c", command], stderr=subprocess.PIPE, text=True)
    assert (done.returncode, done.stderr) == (0, "") and (tmp_path / "b.spz").exists()


def test_python_without_docstrings_is_refused_in_a_line():
    command = [sys.executable, "-OO", "-m", "ssplat_jax.commands.start", "--help"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2 and "got -OO" in done.stderr and done.stderr.count("\n") == 1


def started(*arguments, **environment):
    """A command line as the script starts it."""
    command = [sys.executable, "-m", "ssplat_jax.commands.start", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, env=os.environ | environment)
