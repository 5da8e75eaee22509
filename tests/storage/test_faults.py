"""A run that is killed or stopped repeatedly at any moment gives the same result as an uninterrupted run."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from ssplat_jax.core.atomic import previous_path
from ssplat_jax.storage.saved_states import load_newest_state
from tests.commands.command_fixture import SIZE, make_capture
from tests.storage.killed_run import STEPS

ROOT = Path(__file__).resolve().parents[2]
NUM_CHUNKS, CHUNK_SIZE = 64, 4
NUM_KILLS = 40
LAST_CHUNKS = 6  # this near the end, lives are killed at their first save, so that the stream outlasts the kills
TIMEOUT = 600.0  # seconds; a life takes about ten

# Fields of metrics.json that do not depend on the scene.
FIELDS_OF_ONE_PROCESS = ("compile_s", "step_memory_bytes", "peak_memory_bytes")

pytestmark = pytest.mark.slow


class Runs:
    """Repeated `ssplat run` of one capture into one folder."""

    def __init__(self, capture: Path, out: Path, save_every: int = 1) -> None:
        self.out, self.state, self.notes = out, out / "state.npz", out.with_suffix(".notes")
        self.arguments = ("run", str(capture), "--out", str(out), "--save-every", str(save_every))
        self.arguments += ("--refine", "0", "--quiet")

    def start(self, moment: str = "-") -> subprocess.Popen:
        self.notes.unlink(missing_ok=True)
        command = [sys.executable, "-m", "tests.storage.killed_run", str(self.notes), moment, *self.arguments]
        # XLA logs messages about the processor when it loads a program from the tests' cache.
        quiet = {**os.environ, "TF_CPP_MIN_LOG_LEVEL": "3"}
        return subprocess.Popen(command, cwd=ROOT, env=quiet, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)

    def end(self, process: subprocess.Popen) -> tuple[int, str]:
        """Waits for a process and returns its exit code and stderr."""
        _, errors = process.communicate(timeout=TIMEOUT)
        assert "Traceback" not in errors, errors
        return process.returncode, errors

    def to_the_end(self) -> dict[str, bytes | dict]:
        """Contents of all results of the run, which ends by itself."""
        code, errors = self.end(self.start())
        assert code == 0, errors
        files = [self.state, self.out / "scene.ply", *sorted((self.out / "views").iterdir())]
        metrics = json.loads((self.out / "metrics.json").read_text())
        contents: dict[str, bytes | dict] = {file.name: file.read_bytes() for file in files}
        return contents | {"metrics": {k: v for k, v in metrics.items() if k not in FIELDS_OF_ONE_PROCESS}}

    def fed(self) -> list[int]:
        """Numbers of the chunks that the last life processed."""
        return [int(line) for line in self.notes.read_text().split()] if self.notes.exists() else []

    def chunks_on_disk(self) -> int:
        if not self.state.exists() and not previous_path(self.state).exists():
            return 0
        return load_newest_state(self.state)[1]["done"] // CHUNK_SIZE

    def is_between_renames(self) -> bool:
        return not self.state.exists() and previous_path(self.state).exists()


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return make_capture(tmp_path_factory.mktemp("faults") / "capture", NUM_CHUNKS * CHUNK_SIZE, SIZE)


@pytest.fixture(scope="module")
def uninterrupted(capture, tmp_path_factory):
    runs = Runs(capture, tmp_path_factory.mktemp("faults") / "uninterrupted")
    results = runs.to_the_end()
    assert runs.fed() == list(range(1, NUM_CHUNKS + 1))
    assert results["metrics"]["views"] == NUM_CHUNKS * CHUNK_SIZE and results["metrics"]["ply"]["num_written"] > 100
    return results


def assert_equal(results, wanted):
    assert results.keys() == wanted.keys()
    assert [name for name in wanted if results[name] != wanted[name]] == []


def test_kills_in_saves_and_after_them_change_nothing(capture, uninterrupted, tmp_path):
    """A life continues from the state on disk, and loses at most the chunk since its last save."""
    runs, rng, num_torn = Runs(capture, tmp_path / "killed"), np.random.default_rng(0), 0
    for number in range(NUM_KILLS):
        before, was_between, step = runs.chunks_on_disk(), runs.is_between_renames(), STEPS[number % len(STEPS)]
        count = 1 if before >= NUM_CHUNKS - LAST_CHUNKS else rng.integers(1, 4)
        # With a delay, death comes while the state is written, or some time after.
        delay = rng.uniform(0.0, 0.15) if step == "open" else 0.0
        code, errors = runs.end(runs.start(f"state.npz,{step},{count},{delay}"))
        assert code == -signal.SIGKILL, errors
        num_torn += runs.state.with_suffix(".npz.partial").exists() or runs.is_between_renames()
        after, fed = runs.chunks_on_disk(), runs.fed()
        assert fed == list(range(before + 1, before + 1 + len(fed)))
        assert before <= after < NUM_CHUNKS and fed[-1] - after <= 1
        assert errors.count("Continuing from the state saved before") == len(errors.splitlines()) == was_between
    assert num_torn >= NUM_KILLS // 4
    for file in ("scene.ply", "00000.png", "metrics.json"):  # kills while the results are written
        code, errors = runs.end(runs.start(f"{file},rename,1,0"))
        assert code == -signal.SIGKILL, errors
    assert_equal(runs.to_the_end(), uninterrupted)
    assert [p.name for p in runs.out.rglob("*.partial")] == []


def test_sigterm_and_ctrl_c_save_the_state_before_exiting(capture, uninterrupted, tmp_path):
    runs = Runs(capture, tmp_path / "stopped", save_every=1000)  # so that all states but the last are due to signals
    for number, code in ((signal.SIGTERM, 143), (signal.SIGINT, 130)):
        before, process = runs.chunks_on_disk(), runs.start()
        while len(runs.fed()) < 2:
            assert process.poll() is None
            time.sleep(0.001)
        process.send_signal(number)
        words = "stopped after {} views; the same command continues\n"
        assert runs.end(process) == (code, words.format(CHUNK_SIZE * runs.chunks_on_disk()))
        assert runs.fed() == list(range(before + 1, runs.chunks_on_disk() + 1))
    assert_equal(runs.to_the_end(), uninterrupted)
