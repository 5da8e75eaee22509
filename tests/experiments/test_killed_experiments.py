"""All experiments, killed at random moments, end with the files of an undisturbed run, times aside."""

import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.slow

NUM_KILLS = 5
IS_TIME = re.compile(r"(^|_)(ms|seconds|second|s)(_|$)")
"""Columns that hold times or speeds."""


def start(out, programs):
    code = "from ssplat_jax.commands.start import start; start()"
    command = (sys.executable, "-c", code, "experiment", "all", "--scale", "smoke", "--out", str(out), "--quiet")
    # Later lives take their programs from the disk, so that the kills spread over the measurements.
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(programs)}
    with _log(out).open("w") as log:
        return subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=log)


def _log(out: Path) -> Path:
    """File beside the results that takes what the last life said."""
    return out.with_suffix(".log")


def without_times(value):
    if isinstance(value, dict):
        return {name: without_times(x) for name, x in value.items() if not IS_TIME.search(name)}
    return [without_times(x) for x in value] if isinstance(value, list) else value


def results(out: Path) -> dict:
    """All files by name: the cases without their times, pictures as they are, and of the rest the names."""
    found = {}
    for path in sorted(p for p in out.rglob("*") if p.is_file()):
        is_case = path.parent.name == "cases"
        content = without_times(json.loads(path.read_text())) if is_case and path.suffix == ".json" else None
        found[str(path.relative_to(out))] = path.read_bytes() if is_case and path.suffix == ".png" else content
    return found


def test_killed_experiments_end_with_the_same_files(tmp_path):
    programs = tmp_path / "programs"
    since = time.monotonic()
    whole = start(tmp_path / "whole", programs)
    assert whole.wait() == 0, _log(tmp_path / "whole").read_text()
    took, rng = time.monotonic() - since, np.random.default_rng()
    kills = 0
    for delay in rng.uniform(3.0, 0.5 * took, NUM_KILLS):
        life = start(tmp_path / "killed", programs)
        try:
            life.wait(delay)
            break
        except subprocess.TimeoutExpired:
            life.kill()
            life.wait()
            kills += 1
    last = start(tmp_path / "killed", programs)
    assert last.wait() == 0, _log(tmp_path / "killed").read_text()
    assert kills > 0
    assert results(tmp_path / "killed") == results(tmp_path / "whole")
