"""Rotations against Rodrigues' formula in float64, also where formulas could divide by zero."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.core import rotations
from ssplat_jax.core.rotations import matrices_to_quats

quats_to_matrices, multiply_quats = jax.jit(rotations.quats_to_matrices), jax.jit(rotations.multiply_quats)
GRADIENT = jax.jit(jax.grad(lambda q: jnp.sum(quats_to_matrices(q) * jnp.arange(9.0).reshape(3, 3))))
FLOAT32 = 1e-6  # a few roundings of numbers up to 1
MIXED_AXES = [[1, 1, 0], [0, 1, 1], [1, 0, 1], [1, 1, 1], [-1, 2, 3], [1, -1, 0], [1e-4, 1, 1e-5]]
AXES = np.concatenate([np.eye(3), MIXED_AXES / np.linalg.norm(MIXED_AXES, axis=1, keepdims=True)])
ANGLES = np.array([0.0, 1e-8, 1e-4, 0.3, np.pi / 2, 2 * np.pi / 3, 3.0, np.pi - 1e-3, np.pi - 1e-6, np.pi])


def rodrigues(axis, angle):
    """Rodrigues' formula, R = I + sin(a) K + (1 - cos(a)) K^2, in float64."""
    x, y, z = axis / np.linalg.norm(axis)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


def cases():
    """Quaternions and matrices of every axis and angle, in float64."""
    quats, matrices = [], []
    for axis in AXES:
        for angle in np.r_[ANGLES, -ANGLES]:
            quats.append(np.r_[np.cos(angle / 2), np.sin(angle / 2) * axis])
            matrices.append(rodrigues(axis, angle))
    return np.array(quats), np.array(matrices)


@pytest.mark.parametrize("length", [1e-9, 1e-3, 1.0, 7.0, 1e20])
def test_quaternions_of_any_length_and_sign_are_the_rotations_of_rodrigues(length):
    quats, matrices = cases()
    for sign in (1, -1):
        got = quats_to_matrices(jnp.asarray(sign * length * quats, jnp.float32))
        np.testing.assert_allclose(got, matrices, atol=FLOAT32)


def test_matrices_to_quats_gives_unit_quats_of_the_rotation():
    _, matrices = cases()
    quats = np.asarray(jax.jit(matrices_to_quats)(jnp.asarray(matrices, jnp.float32)), np.float64)
    np.testing.assert_allclose(np.linalg.norm(quats, axis=-1), 1.0, atol=FLOAT32)
    assert (quats[:, 0] >= 0).all()
    np.testing.assert_allclose(quats_to_matrices(jnp.asarray(quats, jnp.float32)), matrices, atol=2 * FLOAT32)


def test_the_product_is_the_composition():
    quats, matrices = cases()
    order = np.random.default_rng(0).permutation(len(quats))
    product = multiply_quats(jnp.asarray(quats, jnp.float32), jnp.asarray(quats[order], jnp.float32))
    np.testing.assert_allclose(quats_to_matrices(product), matrices @ matrices[order], atol=2 * FLOAT32)


def test_zero_quaternions_are_the_identity_with_a_zero_gradient():
    tiny = jnp.array([[0.0, 0, 0, 0], [1e-13, 0, -1e-13, 0]])
    np.testing.assert_array_equal(quats_to_matrices(tiny), np.broadcast_to(np.eye(3), (2, 3, 3)))
    np.testing.assert_array_equal(GRADIENT(tiny), 0)


def test_gradients_are_finite_at_every_angle():
    quats, matrices = cases()
    gradient = GRADIENT(jnp.asarray(quats, jnp.float32))
    assert np.isfinite(gradient).all() and np.abs(gradient).max() > 1
    of_quats = jax.jit(jax.grad(lambda m: jnp.sum(matrices_to_quats(m) * jnp.arange(4.0))))
    gradient = of_quats(jnp.asarray(matrices, jnp.float32))
    assert np.isfinite(gradient).all() and np.abs(gradient).max() > 0.1
