"""The side of a tile decides about time alone."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.rasterizer import Effects, render
from ssplat_jax.rasterizer.render import TILES
from tests.rasterizer.scenes import cameras, cloud

EFFECTS = Effects(outputs=("color", "alpha", "depth", "median_depth"))


@pytest.mark.usefixtures("compiled_plainly")
def test_images_and_gradients_are_those_of_any_tile():
    scene, camera = cloud(), cameras(21, 30)  # no multiple of a tile

    def drawn(gaussians, tile):
        out = render(gaussians, camera, effects=EFFECTS, max_pairs=1 << 12, tile=tile)
        images = jnp.concatenate([out.color, out.alpha[..., None], out.depth[..., None]], axis=-1)
        return jnp.sum(images**2), (images, out.median_depth, out.num_overflow)

    found = {t: jax.jit(jax.value_and_grad(drawn, has_aux=True), static_argnums=1)(scene, t) for t in TILES}
    (_, (images, median, _)), gradient = found[8]
    assert float(jnp.abs(images).max()) > 0.5
    for (_, (other, other_median, overflow)), other_gradient in found.values():
        assert int(overflow) == 0
        np.testing.assert_allclose(other, images, atol=2e-5)
        np.testing.assert_allclose(other_median, median, atol=2e-5)
        for a, b in zip(jax.tree.leaves(other_gradient), jax.tree.leaves(gradient), strict=True):
            assert np.linalg.norm(a - b) < 1e-4 * np.linalg.norm(b)
