"""Scene deltas put together equal the whole scene."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.cache.state import grow, init_cache
from ssplat_jax.core.pytree import replace
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.streaming.scene_delta import SceneFeed, apply_delta
from tests.cache.streams import CAPACITY, CONFIG, PLACES, VARIANTS, Recipe, fuse, to_jax, written_rows
from tests.model.small import random_params

HEAD_TOL = 1e-5  # relative and absolute: programs for different numbers of rows may round differently

pytestmark = pytest.mark.usefixtures("compiled_plainly")


def chunk(seed):
    return to_jax(Recipe(seed, PLACES[seed % len(PLACES)], "normal", "random", num_valid=24).tokens())


def carved(cache, rng, config):
    """The cache after views saw some pivots, which sank below the threshold or came back."""
    factor = rng.choice([0.5, 1.0, 1.0, 1.0, 2.0], cache.confidences.shape).astype(np.float32)
    told = rng.uniform(size=cache.observations.shape) * ((factor != 1.0) & np.asarray(cache.alive))[..., None]
    return replace(
        cache,
        confidences=jnp.clip(cache.confidences * factor, 0.0, 0.95),
        observations=cache.observations + jnp.asarray(told, jnp.float32),
    )


def assert_same_scene(received, scene):
    shown = np.asarray(scene.opacities) > 0
    np.testing.assert_array_equal(received.opacities > 0, shown)
    parts = (jax.tree.map(lambda x: np.asarray(x)[shown], gaussians) for gaussians in (received, scene))
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=HEAD_TOL, atol=HEAD_TOL), *parts)


@pytest.mark.parametrize("name", VARIANTS)
def test_deltas_put_together_equal_the_scene(name):
    """Over a stream whose cache grows, with deltas that span several chunks."""
    config = VARIANTS[name]
    model, params, rng = StreamSplat(config), random_params(config), np.random.default_rng(0)
    cache, feed, decode = init_cache(config, CAPACITY), SceneFeed(model, params), jax.jit(model.decode)
    received = None
    for seed in range(6):
        cache = grow(cache, 2 * CAPACITY) if seed == 4 else cache
        cache = carved(fuse(cache, chunk(seed), config), rng, config)
        if seed == 2:
            continue
        received = apply_delta(received, feed.update(cache))
        assert_same_scene(received, decode(params, cache))
    shown = np.asarray(received.opacities) > 0
    assert shown.any() and not shown.all() and cache.capacity == 2 * CAPACITY


def test_a_delta_holds_the_changed_rows_alone(monkeypatch):
    """The time of the last write alone tells which, since the cache has no evidence."""
    config = CONFIG.replace(evidence=False)
    model, params = StreamSplat(config), random_params(config)
    feed, cache = SceneFeed(model, params), init_cache(config, CAPACITY)
    assert len(feed.update(cache).rows) == 0
    cache = fuse(cache, chunk(1), config)
    with monkeypatch.context() as patched, pytest.raises(MemoryError):

        def fails(*given):
            raise MemoryError

        patched.setattr(feed, "_decode_rows", fails)
        feed.update(cache)
    assert set(feed.update(cache).rows) == written_rows(cache)  # a failed update is made up for
    assert len(feed.update(cache).rows) == 0
    row = int(jnp.argmax(jnp.max(cache.confidences, axis=1)))
    assert feed.update(replace(cache, confidences=cache.confidences.at[row].set(0.1))).rows.tolist() == [row]
    assert feed.update(cache).rows.tolist() == [row]
    # A receiver who has the scene of a known cache needs the rest, also where no pivot comes or goes.
    for _ in range(4):  # until every voxel is full
        cache = fuse(cache, chunk(1), config)
    known = jax.tree.map(jnp.copy, cache)
    cache = fuse(cache, chunk(1), config)
    assert set(SceneFeed(model, params, known).update(cache).rows) == written_rows(cache)
