"""Exposure over a whole stream: darker or tinted views do not change the colors of the scene."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.config import preset
from ssplat_jax.core.gaussians import mean_color
from ssplat_jax.core.pytree import replace
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.model.streamsplat import StreamSplat, _flatten_tokens
from ssplat_jax.model.views import patch_colors, prepare_views
from ssplat_jax.storage.weights import load_params
from ssplat_jax.streaming.session import Session
from tests.model.small import CONFIG, chunk

TINT = np.array([0.6, 0.75, 0.9])


def streamed(tint, **changes):
    """Exposures of the second of two chunks, whose views are tinted, and the mean color of the scene."""
    config = preset("tiny").replace(capacity=1 << 12, **changes)
    capture = open_capture("procedural:room?frames=73&size=128x96")
    session = Session(StreamSplat(config), load_params("tiny"))
    frame = capture.stream_frame(config, range(8))
    first, second = capture.chunks(config, range(8), frame=frame)
    session.feed(first)
    out = session.feed(replace(second, images=second.images * jnp.asarray(tint, jnp.float32)))
    return np.asarray(out.exposures), np.asarray(mean_color(session.gaussians()))


@pytest.mark.slow  # two steps with the shipped weights
def test_tint_is_estimated_and_kept_out_of_the_scene():
    exposures, color = streamed(np.ones(3))
    np.testing.assert_allclose(exposures, 1.0, atol=0.01)
    assert np.all(exposures != 1.0)  # the views share enough with the scene for an estimate
    tinted_exposures, tinted_color = streamed(TINT)
    np.testing.assert_allclose(tinted_exposures, np.tile(TINT, (4, 1)), rtol=0.02)
    np.testing.assert_allclose(tinted_color, color, rtol=0.02)
    unmatched_exposures, unmatched_color = streamed(TINT, match_exposure=False)
    np.testing.assert_array_equal(unmatched_exposures, 1.0)
    assert np.all(unmatched_color < 0.97 * color)


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
