"""Colors of tokens: stored at the scene's exposure, so that one surface has one color in every view."""

import jax
import jax.numpy as jnp
import numpy as np

from ssplat_jax.core.pytree import replace
from ssplat_jax.model import patch_colors, prepare_views
from ssplat_jax.model.streamsplat import _flatten_tokens
from tests.model.small import CONFIG, chunk

GAINS = np.array([[0.5, 0.7, 1.0], [1.0, 1.0, 1.0], [2.0, 1.5, 1.25]], np.float32)


@jax.jit
def token_colors(images, exposures):
    views = prepare_views(replace(chunk(), images=images), CONFIG)
    v, hf, wf = views.inside.shape
    maps = jnp.zeros((v, hf, wf))
    feats = jnp.zeros((v, hf, wf, CONFIG.network.token_width))
    tokens = _flatten_tokens(jnp.zeros((v, hf, wf, 3)), feats, maps, maps, exposures, views, CONFIG)
    return tokens.rgbs, patch_colors(views.images, CONFIG)


def test_colors_are_divided_by_their_views_exposure():
    images = chunk().images
    as_seen, patches = token_colors(images, jnp.ones((3, 3)))
    np.testing.assert_array_equal(as_seen, patches.reshape(as_seen.shape))  # view-major, row-major
    brighter, _ = token_colors(images * GAINS[:, None, None], jnp.asarray(GAINS))
    np.testing.assert_allclose(brighter, as_seen, rtol=1e-5)
    darkened, _ = token_colors(images, jnp.asarray(GAINS))
    cells = as_seen.reshape(3, -1, as_seen.shape[1] // 3, 3)
    np.testing.assert_allclose(darkened.reshape(cells.shape), cells / GAINS[:, None, None], rtol=1e-5)
