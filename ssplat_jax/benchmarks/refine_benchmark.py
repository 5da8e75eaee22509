"""Time of a refinement step, and of the same step by another checkout of this package in the same turns.

The scene has the statistics of a streamed room at 320 x 240: 524,288 rows of which 474,000 are present, views that each
see less than half of them, and about 2.8 tiles for each Gaussian that shows. Every checkout works in a process of its
own (`refine_worker.py`), and they take steps by turns, so that a busy machine slows all alike: read the ratios.
"""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from ssplat_jax.core.errors import InputError

WORKER = Path(__file__).with_name("refine_worker.py")
OWN = Path(__file__).parents[2]


class Worker:
    """A process in which one checkout takes refinement steps when it is told to."""

    def __init__(self, checkout: Path, num_rows: int, size: tuple[int, int], steps: int) -> None:
        arguments = [str(x) for x in (num_rows, *size, steps)]
        self._process = subprocess.Popen(
            [sys.executable, "-P", str(WORKER), *arguments],
            env=os.environ | {"PYTHONPATH": str(checkout)},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self._checkout = checkout

    def step(self) -> dict[str, float]:
        """Facts about the next step: `ms`, `loss`."""
        assert self._process.stdin is not None and self._process.stdout is not None
        try:
            self._process.stdin.write("\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            pass  # the process has ended; the line below says so
        line = self._process.stdout.readline()
        if not line:
            raise InputError(f"bench refine: {self._checkout} took no step; give a checkout that has `refine`.")
        return json.loads(line)

    def close(self) -> None:
        """Ends the process."""
        self._process.kill()
        self._process.communicate()


def bench_refine(
    against: Path | None = None,
    *,
    num_rows: int = 524_288,
    size: tuple[int, int] = (320, 240),
    repetitions: int = 7,
) -> list[dict[str, Any]]:
    """All rows, each `{name, value, unit}`.

    Args:
        against: root of another checkout of this package, timed in the same run.
        num_rows: rows of the scene; nine tenths are present.
        size: width and height of the views.
        repetitions: timed steps of each checkout, by turns; the first step compiles and is not timed.

    Returns:
        Medians of the milliseconds, and the median ratio of consecutive steps; the losses of the last step.

    Raises:
        InputError: `against` is no checkout, or cannot take a step.
    """
    checkouts = {"step": OWN}
    if against is not None:
        if not (against / "ssplat_jax" / "refinement").is_dir():
            raise InputError(
                f"bench refine: --against wants the root of a checkout with ssplat_jax/refinement, got {against}."
            )
        checkouts["against_step"] = against.resolve()
    workers = {name: Worker(root, num_rows, size, repetitions + 1) for name, root in checkouts.items()}
    try:
        for worker in workers.values():
            worker.step()
        steps = [{name: worker.step() for name, worker in workers.items()} for _ in range(repetitions)]
    finally:
        for worker in workers.values():
            worker.close()
    label = f"{num_rows}_{size[0]}x{size[1]}"
    times = {name: np.array([step[name]["ms"] for step in steps]) for name in checkouts}
    rows = [{"name": f"{label}/{name}", "value": float(np.median(t)), "unit": "ms"} for name, t in times.items()]
    rows += [{"name": f"{label}/{name}_loss", "value": steps[-1][name]["loss"], "unit": "L1"} for name in checkouts]
    if against is not None:
        ratio = float(np.median(times["step"] / times["against_step"]))
        rows.append({"name": f"{label}/step_over_against", "value": ratio, "unit": "ratio"})
    return rows
