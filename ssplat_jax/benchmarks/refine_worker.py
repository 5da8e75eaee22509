"""The process of `ssplat bench refine`: a script that takes one refinement step for each line that it reads.

It uses only `refine` and what that is given, so that it runs with any checkout of the package that has it.
"""

import json
import sys
import time

import jax.numpy as jnp
import numpy as np

from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.refinement import RefineConfig, refine

PRESENT = 0.904
"""Fraction of the rows that are present."""
SHOWN = 0.47
"""Fraction of them that a view sees: they stand around the cameras over a wider angle."""
PIXELS = 0.75
"""Standard deviation on the screen, about."""
NUM_VIEWS = 8


def scene(num_rows: int, width: int, height: int) -> tuple[Gaussians, Camera]:
    """Gaussians all around, at depths from 1 to 5, and cameras that turn between them."""
    random, focal = np.random.default_rng(0), 0.9 * width
    field = 2 * np.arctan(0.5 * width / focal)
    around = field / SHOWN
    depths = random.uniform(1, 5, num_rows)
    angles = random.uniform(-0.5, 0.5, num_rows) * around
    heights = random.uniform(-0.5, 0.5, num_rows) * height / focal
    scales = (PIXELS * depths / focal)[:, None] * np.exp(random.normal(0, 0.4, (num_rows, 3)))
    is_present = random.random(num_rows) < PRESENT
    single = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    gaussians = Gaussians.from_rgb(
        means=single(depths[:, None] * np.stack([np.sin(angles), heights, np.cos(angles)], axis=1)),
        quats=single(random.normal(size=(num_rows, 4))),
        scales=single(scales),
        opacities=single(np.where(is_present, random.uniform(0.2, 0.95, num_rows), 0.0)),
        colors=single(random.uniform(0, 1, (num_rows, 3))),
    )
    turns = np.linspace(-0.5, 0.5, NUM_VIEWS) * (around - field)
    viewmats = np.tile(np.eye(4), (NUM_VIEWS, 1, 1))
    viewmats[:, 0, 0] = viewmats[:, 2, 2] = np.cos(turns)
    viewmats[:, 2, 0] = np.sin(turns)
    viewmats[:, 0, 2] = -np.sin(turns)
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    camera = Camera(viewmats=single(viewmats), Ks=single(np.tile(K, (NUM_VIEWS, 1, 1))), width=width, height=height)
    return gaussians, camera


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
