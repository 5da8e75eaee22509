"""Second derivatives of `render`: forward over reverse is exact, reverse over reverse is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.rasterizer import Effects, render
from ssplat_jax.rasterizer.reference import render_reference
from tests.rasterizer.scenes import cameras, cloud

EFFECTS = Effects(background=(0.2, 0.5, 0.9))


def loss_of(renderer, **options):
    def loss(scene):
        out = renderer(*scene, effects=EFFECTS, **options)
        return jnp.sum((out.color - 0.3) ** 2) + 0.1 * jnp.sum(out.depth**2) + jnp.sum(out.alpha**2)

    return loss


def test_second_derivatives_equal_the_reference_in_float64():
    """The product of the Hessian with a vector, in float32, of every row of the scene and of the cameras."""
    scene, random = (cloud(degree=1), cameras(21, 30, batch=2)), np.random.default_rng(0)
    directions = jax.tree.map(lambda x: random.normal(size=x.shape), scene)

    def product(loss, scene):
        along = jax.tree.map(lambda x, d: jnp.asarray(d, x.dtype), scene, directions)
        return jax.jit(lambda s, d: jax.jvp(jax.grad(loss), (s,), (d,))[1])(scene, along)

    got = product(loss_of(render, max_pairs=1 << 12), scene)
    with jax.enable_x64(True):
        doubles = jax.tree.map(lambda x: x.astype(jnp.float64), scene)
        wanted = jax.tree.map(np.asarray, product(loss_of(render_reference, rows_at_once=30), doubles))
    for (path, a), b in zip(jax.tree_util.tree_leaves_with_path(got), jax.tree.leaves(wanted), strict=True):
        a = np.asarray(a, np.float64)
        assert np.linalg.norm(a - b) < 1e-3 * np.linalg.norm(b), jax.tree_util.keystr(path)


def test_reverse_over_reverse_is_refused():
    loss = loss_of(render, max_pairs=1 << 12)
    with pytest.raises(ValueError, match="Reverse-mode differentiation does not work"):
        jax.grad(lambda s: sum(jnp.sum(x) for x in jax.tree.leaves(jax.grad(loss)(s))))((cloud(6), cameras(12, 10)))
