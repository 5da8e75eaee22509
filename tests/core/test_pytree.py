"""The pytree decorator: checked when built by hand, transparent to every transform."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ssplat_jax.core.gaussians import mask_gaussians
from ssplat_jax.core.pytree import pytree, replace, static
from tests.rasterizer.scenes import cloud


@pytree
class Body:
    mass: Float[Array, "*b"]
    speed: Float[Array, "*b 3"]
    name: str = static(default="ball")


def body(n: int = 4, name: str = "ball") -> Body:
    return Body(mass=jnp.arange(n, dtype=jnp.float32), speed=jnp.ones((n, 3)), name=name)


def test_only_a_change_of_statics_recompiles():
    traces = []

    @jax.jit
    def momentum(b):
        traces.append(b.name)
        return b.mass[:, None] * b.speed

    momentum(body())
    momentum(replace(body(), mass=jnp.zeros(4)))
    assert traces == ["ball"]
    momentum(body(name="brick"))
    assert traces == ["ball", "brick"]
    assert jax.tree.structure(body()) != jax.tree.structure(body(name="brick"))


def test_masked_gaussians_are_absent_and_harmless():
    spoiled = replace(cloud(3), means=cloud(3).means.at[1].set(jnp.nan), scales=jnp.full((3, 3), jnp.inf))
    masked = mask_gaussians(spoiled, jnp.array([True, False, False]))
    np.testing.assert_array_equal(masked.opacities[1:], 0)
    assert np.isfinite(masked.means).all() and np.isfinite(masked.scales[1:]).all()
    np.testing.assert_array_equal(masked.quats[1:], [[1, 0, 0, 0]] * 2)
    assert np.isinf(masked.scales[0]).all()  # what is kept is kept as it is
