"""jax 0.10.2 compiles vmapped 3-vector functions wrongly on the CPU: the last rows of a batch come out wrong.

The dependency excludes that release. This test keeps the pattern, so that another release with the fault is caught, and
checks that our own functions, which are written with einsum and broadcasting, are right for the same batch sizes.
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

SIZES = (*range(1, 18), 31, 33)  # past one and two widths of 16 lanes, every remainder once
FLOAT32 = 5e-6


def rotate(quat, point):
    """One 3-vector rotated by one quaternion wxyz, the way nobody here should write it."""
    unit = quat / jnp.sqrt(jnp.sum(quat * quat))
    turned = jnp.cross(unit[1:], point)
    return point + 2 * (unit[0] * turned + jnp.cross(unit[1:], turned))


@jax.jit
def rotate_all(quats, points):
    return jax.vmap(rotate)(quats, points)


@jax.jit
def rotate_broadcast(quats, points):
    matrices = quats_to_matrices(quats)
    poses = jnp.zeros((len(quats), 4, 4)).at[:, :3, :3].set(matrices).at[:, 3, 3].set(1.0)
    return transform_points(poses, points[:, None])[:, 0]


def oracle(quats, points):
    quats = quats / np.linalg.norm(quats, axis=-1, keepdims=True)
    turned = np.cross(quats[:, 1:], points)
    return points + 2 * (quats[:, :1] * turned + np.cross(quats[:, 1:], turned))


@pytest.mark.parametrize("name", [pytest.param("rotate_all", marks=pytest.mark.slow), "rotate_broadcast"])
def test_every_row_of_every_batch_size_is_right(name):
    """In a process of its own, which compiles as users do; the fault is one of optimization."""
    run = [sys.executable, "-c", f"from {__name__} import check, {name}; check({name})"]
    environment = os.environ | {"XLA_FLAGS": ""}
    done = subprocess.run(run, cwd=Path(__file__).parents[2], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def check(rotated) -> None:
    """Raises where a row of any batch size is wrong."""
    rng = np.random.default_rng(0)
    for n in SIZES:
        quats, points = rng.normal(size=(n, 4)), rng.normal(size=(n, 3))
        got = rotated(jnp.asarray(quats, jnp.float32), jnp.asarray(points, jnp.float32))
        np.testing.assert_allclose(got, oracle(quats, points), atol=FLOAT32, err_msg=f"n = {n}")
