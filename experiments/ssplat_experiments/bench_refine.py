"""`ssplat bench refine`: time of a refinement step, and of the same step by another checkout in the same turns.

The scene has the statistics of a streamed room at 320 x 240: 524,288 rows of which 474,000 are present, views that each
see less than half of them, and about 2.8 tiles for each Gaussian that shows. Every checkout works in a process of its
own, which runs this file as a script, and they take steps by turns, so that a busy machine slows all alike: read the
ratios. The script uses only `refine` and what that is given.
"""

import contextlib
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.refinement import RefineConfig, refine

OWN = Path(__file__).parents[2]
PRESENT = 0.904  # fraction of the rows that are present
SHOWN = 0.47  # fraction of them that a view sees: they stand around the cameras over a wider angle
PIXELS = 0.75  # standard deviation on the screen, about
NUM_VIEWS = 8


class Worker:
    """A process in which one checkout takes refinement steps when it is told to."""

    def __init__(self, checkout: Path, num_rows: int, size: tuple[int, int], steps: int) -> None:
        arguments = [str(x) for x in (num_rows, *size, steps)]
        self._process = subprocess.Popen(
            [sys.executable, "-P", __file__, *arguments],
            env=os.environ | {"PYTHONPATH": str(checkout)},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self._checkout = checkout

    def step(self) -> dict[str, float]:
        """Facts about the next step: `ms`, `loss`."""
        with contextlib.suppress(BrokenPipeError):  # the process has ended; the line below says so
            print(file=self._process.stdin, flush=True)
        line = self._process.stdout.readline() if self._process.stdout else ""
        if not line:
            raise InputError(f"bench refine: {self._checkout} took no step; give a checkout that has `refine`.")
        return json.loads(line)

    def close(self) -> None:
        """Ends the process."""
        self._process.kill()
        self._process.communicate()


def run(
    against: Path | None = None,
    *,
    num_rows: int = 524_288,
    size: tuple[int, int] = (320, 240),
    repetitions: int = 7,
) -> list[dict[str, Any]]:
    """Medians of the milliseconds, the median ratio of consecutive steps, and the losses of the last step.

    Args:
        against: root of another checkout of this package, timed in the same run.
        num_rows: rows of the scene; nine tenths are present.
        size: width and height of the views.
        repetitions: timed steps of each checkout, by turns; the first step compiles and is not timed.

    Raises:
        InputError: `against` is no checkout, or cannot take a step.
    """
    checkouts = {"step": OWN}
    if against is not None:
        if not (against / "ssplat_jax" / "refinement").is_dir():
            raise InputError(f"bench refine: --against wants the root of a checkout, got {against}.")
        checkouts["against_step"] = against.resolve()
    workers = {name: Worker(root, num_rows, size, repetitions + 1) for name, root in checkouts.items()}
    try:
        for worker in workers.values():
            worker.step()
        steps = [{name: worker.step() for name, worker in workers.items()} for _ in range(repetitions)]
    finally:
        for worker in workers.values():
            worker.close()
    times = {name: np.array([step[name]["ms"] for step in steps]) for name in checkouts}
    found = [(name, float(np.median(t)), "ms") for name, t in times.items()]
    found += [(f"{name}_loss", steps[-1][name]["loss"], "L1") for name in checkouts]
    if against is not None:
        found.append(("step_over_against", float(np.median(times["step"] / times["against_step"])), "ratio"))
    label = f"{num_rows}_{size[0]}x{size[1]}"
    return [{"name": f"{label}/{name}", "value": value, "unit": unit} for name, value, unit in found]


def scene(num_rows: int, width: int, height: int) -> tuple[Gaussians, Camera]:
    """Gaussians all around, at depths from 1 to 5, and cameras that turn between them."""
    random, focal = np.random.default_rng(0), 0.9 * width
    field = 2 * np.arctan(0.5 * width / focal)
    around = field / SHOWN
    depths = random.uniform(1, 5, num_rows)
    angles = random.uniform(-0.5, 0.5, num_rows) * around
    heights = random.uniform(-0.5, 0.5, num_rows) * height / focal
    is_present = random.random(num_rows) < PRESENT
    single = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    gaussians = Gaussians.from_rgb(
        means=single(depths[:, None] * np.stack([np.sin(angles), heights, np.cos(angles)], axis=1)),
        quats=single(random.normal(size=(num_rows, 4))),
        scales=single((PIXELS * depths / focal)[:, None] * np.exp(random.normal(0, 0.4, (num_rows, 3)))),
        opacities=single(np.where(is_present, random.uniform(0.2, 0.95, num_rows), 0.0)),
        colors=single(random.uniform(0, 1, (num_rows, 3))),
    )
    turns = np.linspace(-0.5, 0.5, NUM_VIEWS) * (around - field)
    viewmats = np.tile(np.eye(4), (NUM_VIEWS, 1, 1))
    viewmats[:, 0, 0] = viewmats[:, 2, 2] = np.cos(turns)
    viewmats[:, 2, 0], viewmats[:, 0, 2] = np.sin(turns), -np.sin(turns)
    Ks = single(np.tile([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], (NUM_VIEWS, 1, 1)))
    return gaussians, Camera(viewmats=single(viewmats), Ks=Ks, width=width, height=height)


def main(num_rows: int, width: int, height: int, steps: int) -> None:
    """Takes `steps` steps towards images of noise and writes a line of facts after each."""
    gaussians, cameras = scene(num_rows, width, height)
    images = jnp.asarray(np.random.default_rng(1).uniform(0, 1, (NUM_VIEWS, height, width, 3)), jnp.float32)
    sys.stdin.readline()
    start = time.perf_counter()

    def on_step(_: int, loss: float) -> None:
        nonlocal start
        print(json.dumps({"ms": 1e3 * (time.perf_counter() - start), "loss": loss}), flush=True)
        sys.stdin.readline()
        start = time.perf_counter()

    # Nothing is held back: refinement does not end early.
    refine(gaussians, cameras, images, steps=steps, config=RefineConfig(held_back=0.0), on_step=on_step)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
