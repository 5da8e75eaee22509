"""Functions of 3-vectors are right for every row of every batch size.

jax 0.10.2 compiles `vmap` of them wrongly on the CPU: the last rows of a batch come out wrong. The dependency excludes
that release; our own functions are written with einsum and broadcasting, and are checked for other faults of this kind.
"""

import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.core.cameras import transform_points
from ssplat_jax.core.rotations import quats_to_matrices

SIZES = (1, 2, 3, 4, 5, 7, 8, 9, 15, 16, 17, 33)  # about the powers of two, past one and two widths of 16 lanes
FLOAT32 = 5e-6


@jax.jit
def rotated(quats, points):
    poses = jnp.zeros((len(quats), 4, 4)).at[:, :3, :3].set(quats_to_matrices(quats)).at[:, 3, 3].set(1.0)
    return transform_points(poses, points[:, None])[:, 0]


def oracle(quats, points):
    quats = quats / np.linalg.norm(quats, axis=-1, keepdims=True)
    turned = np.cross(quats[:, 1:], points)
    return points + 2 * (quats[:, :1] * turned + np.cross(quats[:, 1:], turned))


@pytest.mark.slow  # tests/core holds the formulas; this is about XLA's optimization of them
def test_every_row_of_every_batch_size_is_right():
    """In a process of its own, which compiles as users do; the fault is one of optimization."""
    run = [sys.executable, "-c", f"from {__name__} import check; check()"]
    environment = os.environ | {"XLA_FLAGS": ""}
    done = subprocess.run(run, cwd=Path(__file__).parents[2], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def check() -> None:
    """Raises where a row of any batch size is wrong."""
    rng = np.random.default_rng(0)
    for n in SIZES:
        quats, points = rng.normal(size=(n, 4)), rng.normal(size=(n, 3))
        got = rotated(jnp.asarray(quats, jnp.float32), jnp.asarray(points, jnp.float32))
        np.testing.assert_allclose(got, oracle(quats, points), atol=FLOAT32, err_msg=f"n = {n}")
