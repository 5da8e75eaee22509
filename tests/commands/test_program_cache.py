"""Programs kept on disk: the same bytes as without, nothing on the terminal, and users' settings hold."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from ssplat_jax.commands import program_cache
from ssplat_jax.commands.program_cache import EXECUTABLES, FOLDER, IS_ON, SWITCH, keep_no_programs, keep_programs
from tests.commands.command_fixture import read

# The fuse of the cache, its buffers donated as in a stream.
FUSING = """
import hashlib
from ssplat_jax.commands.program_cache import keep_programs
keep_programs()
import jax, numpy as np
from tests.cache.streams import CONFIG, Recipe, fuse, init_cache, to_jax
cache, tokens = init_cache(CONFIG), to_jax(Recipe(0, "few", "normal", "random").tokens())
for _ in range(3):
    given = cache
    cache = jax.block_until_ready(fuse(cache, tokens, CONFIG))
    assert given.means.is_deleted(), "not donated"
print(hashlib.sha256(b"".join(np.asarray(x).tobytes() for x in jax.tree.leaves(cache))).hexdigest())
"""


def plain_environment(folder: Path | str) -> dict[str, str]:
    """The variables of a user who has set nothing but the folder."""
    names = ("TF_CPP_MIN_LOG_LEVEL", FOLDER, IS_ON)
    return {name: value for name, value in os.environ.items() if name not in names} | {SWITCH: str(folder)}


@pytest.mark.slow
def test_kept_programs_give_the_same_bytes_say_nothing_and_a_cut_one_is_replaced(tmp_path):
    results = []
    for where in ("off", tmp_path, tmp_path, tmp_path):
        variables = plain_environment(where) | {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
        done = subprocess.run([sys.executable, "-c", FUSING], capture_output=True, text=True, env=variables)
        assert (done.returncode, done.stderr) == (0, ""), done.stderr
        files = {path: path.stat().st_size for path in tmp_path.rglob("*-cache")}
        results.append((done.stdout, files))
        if len(results) == 3:
            largest = max(files, key=lambda path: path.stat().st_size)
            largest.write_bytes(largest.read_bytes()[:500])
    (off, nothing), (cold, written), (warm, kept), (again, mended) = results
    assert off == cold == warm == again != ""
    assert nothing == {} and kept == written != {}
    assert mended.keys() == kept.keys() and mended[largest] > 500


@pytest.mark.slow
def test_a_run_compiles_few_programs_and_with_kept_ones_none_to_the_same_bytes(tmp_path):
    compile_seconds, written, compiled = [], [], []
    for number, where in enumerate(("off", tmp_path / "programs", tmp_path / "programs")):
        out = tmp_path / f"run{number}"
        command = [sys.executable, "-m", "ssplat_jax.commands.start", "run", "procedural:room?frames=16&size=96x64"]
        done = subprocess.run(
            [*command, "--refine", "0", "--out", str(out), "--quiet"],
            capture_output=True,
            text=True,
            env=plain_environment(where) | {"JAX_LOG_COMPILES": "1"},
        )
        compiled.append(done.stderr.count("Finished XLA compilation of"))
        assert done.returncode == 0 and "E1" not in done.stderr and "cpu_aot" not in done.stderr, done.stderr
        metrics = read(out / "metrics.json")
        compile_seconds.append(metrics.pop("compile_s"))
        written.append((metrics, (out / "scene.ply").read_bytes(), (out / "state.npz").read_bytes()))
    assert written[0] == written[1] == written[2]
    assert compile_seconds[2] < 0.7 * min(compile_seconds[:2])
    assert compiled[0] == compiled[1] <= 12 and compiled[2] == 0


def test_what_the_user_has_set_holds(tmp_path, monkeypatch):
    for variables in ({SWITCH: "off"}, {SWITCH: "OFF"}, {IS_ON: "false"}, {IS_ON: "0", SWITCH: "elsewhere"}):
        environment = dict(variables)
        keep_programs(environment)
        assert environment == variables
    environment = {FOLDER: "mine"}
    keep_programs(environment)
    assert environment == {FOLDER: "mine", "TF_CPP_MIN_LOG_LEVEL": "3"}
    (tmp_path / "file").write_bytes(b"")
    environment = {SWITCH: str(tmp_path / "file")}  # no folder can be made there
    keep_programs(environment)
    assert FOLDER not in environment
    environment = {FOLDER: "mine", EXECUTABLES: "ours", IS_ON: "true"}
    keep_no_programs(environment)
    assert environment == {FOLDER: "mine", IS_ON: "false"}
    folders = set()
    for cores in (1, 2):  # each kind of CPU has a folder of its own
        monkeypatch.setattr(program_cache, "num_cores", lambda cores=cores: cores)
        environment = {SWITCH: str(tmp_path)}
        keep_programs(environment)
        folders.add(environment[FOLDER])
        assert Path(environment[EXECUTABLES]).parent == Path(environment[FOLDER])
    assert len(folders) == 2 and all(Path(folder).is_dir() for folder in folders)


def test_a_user_without_a_home_compiles_anew(monkeypatch):
    def no_home(*_):
        raise RuntimeError("could not determine the home directory")

    monkeypatch.setattr("platformdirs.user_cache_path", no_home)
    environment = {}
    keep_programs(environment)
    assert FOLDER not in environment
