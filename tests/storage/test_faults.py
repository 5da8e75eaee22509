"""A run that is killed or stopped repeatedly at any moment gives the same result as an uninterrupted run.

`pytest -m slow -s tests/storage` prints what the sweep did.
"""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from PIL import Image

from ssplat_jax.core.atomic import previous_path
from ssplat_jax.data.procedural.procedural_views import procedural_capture_arrays
from ssplat_jax.storage.saved_states import load_newest_state

ROOT = Path(__file__).resolve().parents[2]
NUM_CHUNKS, CHUNK_SIZE = 64, 4
SIZE = (64, 48)
OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])

NUM_KILLS = 50
SAVES_IN_ALL = 50  # that all lives together complete before they are killed, at least
LAST_CHUNKS = 6  # this near the end, lives are killed at their first save, so that the stream outlasts the kills
TIMEOUT = 600.0  # seconds; a life takes about ten

# Fields of metrics.json that do not depend on the scene.
FIELDS_OF_ONE_PROCESS = ("compile_s", "step_memory_bytes", "peak_memory_bytes")

pytestmark = pytest.mark.slow


class Life(NamedTuple):
    saves: int  # completed before the kill
    step: str | None  # step of the next save at which the process is killed; None: at a random moment after the saves
    delay: float  # seconds; for a life without saves and step, a share of the time to the first save


def plan(rng: np.random.Generator, num_kills: int) -> list[Life]:
    """Half of the kills are at random moments, half inside a save: while it writes, or at one of the other steps."""
    saves = rng.multinomial(SAVES_IN_ALL, np.full(num_kills, 1 / num_kills))
    lives = []
    for number, passed in enumerate(saves):
        if number % 2 == 0:
            lives.append(Life(int(passed), None, rng.uniform(0.0, 0.15) if passed else rng.uniform(0.0, 1.0)))
        else:
            step = ("open", "keep", "rename", "sync")[number // 2 % 4]
            lives.append(Life(int(passed), step, rng.uniform(0.0, 0.01) if step == "open" else 0.0))
    return lives


def write_capture(folder: Path) -> Path:
    """Writes a walk through the procedural room as a transforms.json capture, which opens without rendering."""
    images, _, camtoworlds, Ks = procedural_capture_arrays("room", NUM_CHUNKS * CHUNK_SIZE, SIZE[1], SIZE[0], seed=0)
    (folder / "images").mkdir(parents=True)
    frames = []
    for i, (image, pose) in enumerate(zip(np.asarray(images), np.asarray(camtoworlds, np.float64), strict=True)):
        Image.fromarray((image * 255 + 0.5).astype(np.uint8)).save(folder / "images" / f"{i:05d}.png")
        pose = (pose @ OPENGL_TO_OPENCV).tolist()
        frames.append({"file_path": f"images/{i:05d}.png", "transform_matrix": pose})
    K = np.asarray(Ks[0], np.float64)
    intrinsics = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "w": SIZE[0], "h": SIZE[1]}
    (folder / "transforms.json").write_text(json.dumps(intrinsics | {"frames": frames}))
    return folder


class Runs:
    """Repeated `ssplat run` of one capture into one folder."""

    def __init__(self, capture: Path, out: Path, *options: str, save_every: int = 1) -> None:
        self.out, self.state, self.notes = out, out / "state.npz", out.with_suffix(".notes")
        self.arguments = ("run", str(capture), "--out", str(out), "--save-every", str(save_every))
        self.arguments += ("--refine", "0", "--quiet", *options)

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

    def to_the_end(self) -> None:
        code, errors = self.end(self.start())
        assert code == 0, errors

    def fed(self) -> list[int]:
        """Numbers of the chunks that the last life processed."""
        return [int(line) for line in self.notes.read_text().split()] if self.notes.exists() else []

    def chunks_on_disk(self) -> int:
        if not self.state.exists() and not previous_path(self.state).exists():
            return 0
        return load_newest_state(self.state)[1]["done"] // CHUNK_SIZE

    def is_between_renames(self) -> bool:
        return not self.state.exists() and previous_path(self.state).exists()

    def wait_for(self, process: subprocess.Popen, happened) -> float:
        """Seconds until `happened()`, which must become true before the process ends."""
        since = time.monotonic()
        while not happened():
            assert process.poll() is None, "the process ended early: " + self.end(process)[1]
            assert time.monotonic() - since < TIMEOUT
            time.sleep(0.001)
        return time.monotonic() - since

    def results(self) -> dict[str, bytes | dict]:
        """Contents of all results of the finished run."""
        files = [self.state, self.out / "scene.ply", *sorted((self.out / "views").iterdir())]
        metrics = json.loads((self.out / "metrics.json").read_text())
        contents: dict[str, bytes | dict] = {file.name: file.read_bytes() for file in files}
        return contents | {"metrics": {k: v for k, v in metrics.items() if k not in FIELDS_OF_ONE_PROCESS}}


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return write_capture(tmp_path_factory.mktemp("faults") / "capture")


@pytest.fixture(scope="module")
def uninterrupted(capture, tmp_path_factory):
    return results_without_kills(capture, tmp_path_factory.mktemp("faults") / "uninterrupted")


def results_without_kills(capture: Path, out: Path, *options: str):
    runs = Runs(capture, out, *options)
    runs.to_the_end()
    assert runs.fed() == list(range(1, NUM_CHUNKS + 1))
    results = runs.results()
    assert results["metrics"]["views"] == NUM_CHUNKS * CHUNK_SIZE and results["metrics"]["ply"]["num_written"] > 100
    return results


def assert_equal(results, wanted):
    assert results.keys() == wanted.keys()
    assert [name for name in wanted if results[name] != wanted[name]] == []


def live_and_die(runs: Runs, life: Life, time_to_save: float) -> tuple[float, str]:
    """Runs one life; returns the seconds to its first save (infinity if not measured) and its stderr."""
    if life.step is not None:
        process, waited = runs.start(f"state.npz,{life.step},{life.saves + 1},{life.delay}"), np.inf
    else:
        process, waited = runs.start(), np.inf
        for save in range(life.saves):
            before = modified(runs.state)
            seconds = runs.wait_for(process, lambda before=before: modified(runs.state) not in (before, None))
            waited = seconds if save == 0 else waited
        time.sleep(life.delay if life.saves else life.delay * time_to_save)
        process.kill()
    code, errors = runs.end(process)
    assert code == -signal.SIGKILL, errors
    return waited, errors


def modified(path: Path) -> int | None:
    try:
        return os.stat(path).st_mtime_ns
    except FileNotFoundError:  # between the two renames of a save
        return None


def test_kills_at_random_moments_and_in_saves_change_nothing(capture, uninterrupted, tmp_path):
    kill_and_compare(Runs(capture, tmp_path / "killed"), NUM_KILLS, uninterrupted)


def kill_and_compare(runs: Runs, num_kills: int, wanted) -> None:
    """Kills a run many times, lets it end, and compares its results with those of a run that was left alone."""
    since, time_to_save = time.monotonic(), 5.0
    torn, reached, lost = 0, [], []
    lives = plan(np.random.default_rng(0), num_kills)
    for life in lives:
        before, was_between = runs.chunks_on_disk(), runs.is_between_renames()
        if before >= NUM_CHUNKS - LAST_CHUNKS:
            life = Life(0, life.step, life.delay)
        waited, errors = live_and_die(runs, life, time_to_save)
        time_to_save = min(time_to_save, waited)
        torn += runs.state.with_suffix(".npz.partial").exists() or runs.is_between_renames()
        after, fed = runs.chunks_on_disk(), runs.fed()
        # A life continues from the state on disk and loses at most the chunks since its last save.
        assert fed == list(range(before + 1, before + 1 + len(fed)))
        assert before <= after and (not fed or fed[-1] - after <= 1)
        assert errors.count("Continuing from the state saved before") == len(errors.splitlines()) <= was_between
        assert errors or not (was_between and fed), "the newest state was missing, and nothing was said"
        lost.append(fed[-1] - after if fed else 0)
        reached.append(after)
    assert reached[-1] < NUM_CHUNKS, "the kills must come before the end of the stream"
    for file in ("scene.ply", "00000.png", "metrics.json"):  # kills while the results are written
        code, errors = runs.end(runs.start(f"{file},rename,1,0"))
        assert code == -signal.SIGKILL, errors
    runs.to_the_end()
    assert_equal(runs.results(), wanted)
    assert [p.name for p in runs.out.rglob("*.partial")] == []
    inside = sum(life.step is not None for life in lives)
    assert inside == num_kills // 2 and torn >= num_kills // 4
    print(
        f"\n{len(lives)} kills, {inside} of them at a chosen step of a save, {torn} left a torn save; the last after"
        f" {reached[-1]} of {NUM_CHUNKS} chunks; {sum(lost)} chunks lost in all, at most {max(lost)} in a life;"
        f" {time.monotonic() - since:.0f} s"
    )


def test_sigterm_and_ctrl_c_save_the_state_before_exiting(capture, uninterrupted, tmp_path):
    runs = Runs(capture, tmp_path / "stopped", save_every=1000)  # so that all states but the last are due to signals
    for number, code in ((signal.SIGTERM, 143), (signal.SIGINT, 130)):
        before = runs.chunks_on_disk()
        process = runs.start()
        runs.wait_for(process, lambda: len(runs.fed()) >= 2)
        process.send_signal(number)
        assert runs.end(process) == (
            code,
            f"stopped after {CHUNK_SIZE * runs.chunks_on_disk()} views; the same command continues\n",
        )
        assert runs.fed() == list(range(before + 1, runs.chunks_on_disk() + 1))
    runs.to_the_end()
    assert_equal(runs.results(), uninterrupted)
