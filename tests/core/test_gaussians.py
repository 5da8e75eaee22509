"""`Gaussians` as a value: how it prints, inside and outside of a transform."""

import jax
import jax.numpy as jnp

from ssplat_jax.core.gaussians import Gaussians


def scene(num: int) -> Gaussians:
    return Gaussians(
        means=jnp.zeros((num, 3)),
        quats=jnp.ones((num, 4)),
        scales=jnp.ones((num, 3)),
        opacities=jnp.ones(num),
        sh=jnp.zeros((num, 4, 3)),
    )


def test_printing_a_scene_shows_its_size_and_no_array():
    printed = [repr(scene(1234))]
    jax.jit(lambda g: printed.append(repr(g)) or g.means)(scene(1234))  # traced
    printed.append(repr(jax.eval_shape(lambda: scene(1234))))
    assert printed == ["Gaussians(1,234, SH 1)"] * 3
    assert "object" in repr(jax.tree.map(lambda x: object(), scene(2)))  # no leaf has a shape
