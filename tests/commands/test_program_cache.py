"""Programs kept on disk: the same bytes as without, nothing on the terminal, and users' settings hold."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from ssplat_jax.commands import program_cache
from ssplat_jax.commands.program_cache import EXECUTABLES, FOLDER, IS_ON, SWITCH, keep_no_programs, keep_programs
from tests.commands.command_fixture import read


@pytest.mark.slow
def test_a_run_compiles_few_programs_and_with_kept_ones_none_to_the_same_bytes(tmp_path):
    """Kept programs that were cut off are replaced."""
    compile_seconds, written, compiled, kept = [], [], [], tmp_path / "programs"
    unset = ("TF_CPP_MIN_LOG_LEVEL", FOLDER, IS_ON)  # by a user who has set nothing but the folder
    user = {name: value for name, value in os.environ.items() if name not in unset}
    for number, where in enumerate(("off", kept, kept, kept)):
        out = tmp_path / f"run{number}"
        command = [sys.executable, "-m", "ssplat_jax.commands.start", "run", "procedural:room?frames=16&size=96x64"]
        done = subprocess.run(
            [*command, "--refine", "0", "--out", str(out), "--quiet"],
            capture_output=True,
            text=True,
            env=user | {SWITCH: str(where), "JAX_LOG_COMPILES": "1", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"},
        )
        compiled.append(done.stderr.count("Finished XLA compilation of"))
        assert done.returncode == 0 and "E1" not in done.stderr and "cpu_aot" not in done.stderr, done.stderr
        metrics = read(out / "metrics.json")
        compile_seconds.append(metrics.pop("compile_s"))
        written.append((metrics, (out / "scene.ply").read_bytes(), (out / "state.npz").read_bytes()))
        if number == 2:
            large = [path for path in kept.rglob("*") if path.is_file() and path.stat().st_size > 500]
            for path in large:
                path.write_bytes(path.read_bytes()[:500])
    assert all(result == written[0] for result in written)
    assert compile_seconds[2] < 0.7 * min(compile_seconds[:2])
    assert compiled[0] == compiled[1] <= 12 and compiled[2] == 0
    assert large and all(path.stat().st_size > 500 for path in large)


def kept(**environment: str) -> dict[str, str]:
    """The variables after a process that has these."""
    keep_programs(environment)
    return environment


def test_what_the_user_has_set_holds(tmp_path, monkeypatch):
    for variables in ({SWITCH: "off"}, {SWITCH: "OFF"}, {IS_ON: "false"}, {IS_ON: "0", SWITCH: "elsewhere"}):
        assert kept(**variables) == variables
    assert kept(**{FOLDER: "mine"}) == {FOLDER: "mine", "TF_CPP_MIN_LOG_LEVEL": "3"}
    (tmp_path / "file").write_bytes(b"")
    assert FOLDER not in kept(**{SWITCH: str(tmp_path / "file")})  # no folder can be made there
    environment = {FOLDER: "mine", EXECUTABLES: "ours", IS_ON: "true"}
    keep_no_programs(environment)
    assert environment == {FOLDER: "mine", IS_ON: "false"}
    folders = set()
    for cores in (1, 2):  # each kind of CPU has a folder of its own
        monkeypatch.setattr(program_cache, "num_cores", lambda cores=cores: cores)
        environment = kept(**{SWITCH: str(tmp_path)})
        folders.add(environment[FOLDER])
        assert Path(environment[EXECUTABLES]).parent == Path(environment[FOLDER])
    assert len(folders) == 2 and all(Path(folder).is_dir() for folder in folders)


def test_a_user_without_a_home_compiles_anew(monkeypatch):
    def no_home(*_):
        raise RuntimeError("could not determine the home directory")

    monkeypatch.setattr("platformdirs.user_cache_path", no_home)
    assert FOLDER not in kept()
