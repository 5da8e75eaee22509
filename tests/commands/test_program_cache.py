"""Programs kept on disk: the same bytes as without, nothing on the terminal, and users' settings hold."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from ssplat_jax.commands import main, program_cache
from ssplat_jax.commands.program_cache import FOLDER, IS_ON, SWITCH, drop_newest, keep_programs

# The fuse of the cache, its buffers donated as in a stream.
FUSING = """
import hashlib, sys
from ssplat_jax.commands.program_cache import keep_programs
keep_programs()
import jax, numpy as np
from ssplat_jax.benchmarks.cache_benchmark import compile_fuse
from ssplat_jax.cache import Tokens, init_cache
from ssplat_jax.config import preset
config = preset("tiny").replace(capacity=1024)
r, n = np.random.default_rng(0), 512
f = lambda *shape: jax.numpy.asarray(r.uniform(0.1, 1, (n, *shape)), "float32")
chunk = Tokens(means=f(3), feats=f(config.network.token_width), confidences=f(), rgbs=f(12), quats=f(4),
               footprints=f(), valid=jax.numpy.ones(n, bool))
fuse, cache = compile_fuse(config, 1024, chunk), init_cache(config)
for _ in range(3):
    given = cache
    cache = jax.block_until_ready(fuse(cache, chunk))
    assert given.means.is_deleted(), "not donated"
print(hashlib.sha256(b"".join(np.asarray(x).tobytes() for x in jax.tree.leaves(cache))).hexdigest())
"""


def plain_environment(folder: Path | str) -> dict[str, str]:
    """The variables of a user who has set nothing but the folder."""
    names = ("TF_CPP_MIN_LOG_LEVEL", FOLDER, IS_ON)
    return {name: value for name, value in os.environ.items() if name not in names} | {SWITCH: str(folder)}


def test_kept_programs_give_the_same_bytes_and_say_nothing(tmp_path):
    results = []
    for where in ("off", tmp_path, tmp_path):
        variables = plain_environment(where) | {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
        done = subprocess.run([sys.executable, "-c", FUSING], capture_output=True, text=True, env=variables)
        assert (done.returncode, done.stderr) == (0, ""), done.stderr
        files = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*-cache")}
        results.append((done.stdout, files))
    (off, nothing), (cold, written), (warm, read) = results
    assert off == cold == warm != ""
    assert nothing == {} and read == written != {}


@pytest.mark.slow
def test_a_run_with_kept_programs_writes_the_same_bytes(tmp_path):
    compile_seconds, written = [], []
    for number, where in enumerate(("off", tmp_path / "programs", tmp_path / "programs")):
        out = tmp_path / f"run{number}"
        command = [sys.executable, "-m", "ssplat_jax.commands.start", "run", "procedural:room?frames=16&size=96x64"]
        done = subprocess.run(
            [*command, "--out", str(out), "--quiet"], capture_output=True, text=True, env=plain_environment(where)
        )
        assert done.returncode == 0 and "E1" not in done.stderr and "cpu_aot" not in done.stderr, done.stderr
        metrics = json.loads((out / "metrics.json").read_text())
        compile_seconds.append(metrics.pop("compile_s"))
        results = {path.name: path.read_bytes() for path in out.rglob("*.*") if path.name != "metrics.json"}
        written.append((metrics, results))
    assert written[0] == written[1] == written[2]
    assert compile_seconds[2] < 0.7 * min(compile_seconds[:2])


def test_every_command_keeps_its_programs_but_those_that_measure_compiling(monkeypatch):
    """`main` asks for it before the command runs, which is when JAX is imported."""
    for name, command in main.COMMANDS.items():
        order = []
        monkeypatch.setattr(main, "keep_programs", lambda order=order: order.append("kept"))
        monkeypatch.setattr(main, "_parse", lambda words, command=command: object.__new__(command))
        monkeypatch.setattr(command, "run", lambda self, order=order: order.append("run") or 0)
        with pytest.raises(SystemExit):
            main.main([name])
        assert order == (["run"] if name in ("bench", "experiment") else ["kept", "run"]), name


@pytest.mark.parametrize(
    "variables", [{SWITCH: "off"}, {SWITCH: "OFF"}, {IS_ON: "false"}, {IS_ON: "0", SWITCH: "elsewhere"}]
)
def test_the_cache_can_be_turned_off(variables):
    environment = dict(variables)
    keep_programs(environment)
    assert environment == variables


def test_a_folder_that_is_set_already_holds():
    environment = {FOLDER: "mine"}
    keep_programs(environment)
    assert environment == {FOLDER: "mine", "TF_CPP_MIN_LOG_LEVEL": "3"}


def test_each_kind_of_cpu_has_a_folder_of_its_own(tmp_path, monkeypatch):
    folders = set()
    for cores in (1, 2):
        monkeypatch.setattr(program_cache, "num_cores", lambda cores=cores: cores)
        environment = {SWITCH: str(tmp_path)}
        keep_programs(environment)
        folders.add(environment[FOLDER])
    assert len(folders) == 2 and all(Path(folder).is_dir() for folder in folders)


def test_a_folder_that_cannot_be_made_leaves_the_cache_off(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    environment = {SWITCH: str(tmp_path / "file")}
    keep_programs(environment)
    assert FOLDER not in environment


def test_programs_of_an_interrupts_last_seconds_are_dropped(tmp_path, monkeypatch):
    old, new, other = (tmp_path / name for name in ("a-cache", "b-cache", "notes.txt"))
    for file in (old, new, other):
        file.write_bytes(b"x")
    os.utime(old, (0, 0))
    monkeypatch.setattr(program_cache, "_our_folder", tmp_path)
    drop_newest(5.0)
    assert old.exists() and other.exists() and not new.exists()
