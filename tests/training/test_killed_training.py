"""Training is a function of its seed, also when it is killed and resumed."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.training.killed_training import STEPS

KILLS = 10
REPOSITORY = Path(__file__).resolve().parents[2]


def start(out) -> subprocess.Popen:
    # LLVM's passes take longer than these steps.
    environment = os.environ | {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}
    command = [sys.executable, "-m", "tests.training.killed_training", str(out)]
    return subprocess.Popen(command, cwd=REPOSITORY, env=environment, stdout=subprocess.PIPE, text=True)


def finish(out) -> dict[str, np.ndarray]:
    """Final state of a run that continues to its end."""
    with start(out) as process:
        assert process.stdout is not None
        steps = [int(line) for line in process.stdout]
    assert process.returncode == 0 and steps[-1] == STEPS
    with np.load(out / "final.npz") as arrays:
        return dict(arrays)


def killed_at(out, step: int) -> None:
    """Runs until `step` is reported and kills the process there, during a save or between two."""
    with start(out) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if int(line) >= step:
                process.kill()
                break
    assert process.returncode == -9


def assert_equal(a, b):
    assert a.keys() == b.keys()
    for name, x in a.items():
        np.testing.assert_array_equal(x, b[name], name)


@pytest.mark.slow  # 12 processes that load JAX and a training step each
def test_runs_of_one_seed_are_bit_equal_even_if_killed(tmp_path):
    whole = finish(tmp_path / "first")
    assert len(whole) > 50 and all(np.isfinite(x).all() for x in whole.values() if x.dtype.kind == "f")
    assert_equal(whole, finish(tmp_path / "second"))
    rng = np.random.default_rng(0)
    for step in np.sort(rng.choice(np.arange(5, STEPS - 5), KILLS, replace=False)):
        killed_at(tmp_path / "killed", int(step))
    assert_equal(whole, finish(tmp_path / "killed"))
