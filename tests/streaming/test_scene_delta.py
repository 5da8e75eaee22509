"""A follower that is told only what changed holds the whole scene."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.cache import grow, init_cache
from ssplat_jax.checkpoint.delta_files import load_delta, save_delta
from ssplat_jax.errors import StorageError
from ssplat_jax.model.compact.gaussian_head import GaussianHead
from ssplat_jax.pytree import replace
from ssplat_jax.streaming.scene_delta import SceneFeed, apply_delta
from ssplat_jax.streaming.streamsplat import StreamSplat
from tests.cache.streams import CAPACITY, CONFIG, PLACES, Recipe, fuse, to_jax

CONFIGS = {
    "voxel": CONFIG,
    "evict": CONFIG.replace(overflow="evict_lowest", pivots_per_voxel=2),
    "append": CONFIG.replace(vacc="append"),
}
HEAD_TOL = 1e-5  # relative and absolute: a program for another number of rows may round otherwise

pytestmark = pytest.mark.usefixtures("compiled_plainly")


def decoder_params(config):
    head = GaussianHead(config).init(jax.random.key(0), jnp.zeros((1, config.network.token_width)))["params"]
    kernel = jax.random.normal(jax.random.key(1), head["out"]["kernel"].shape)
    return {"decoder": head | {"out": head["out"] | {"kernel": kernel}}}


def chunk(seed):
    return to_jax(Recipe(seed, PLACES[seed % len(PLACES)], "normal", "random", num_valid=24).tokens())


def carved(cache, rng, config):
    """Some pivots sink below the threshold, some come back, most stay."""
    factor = rng.choice([0.5, 1.0, 1.0, 1.0, 2.0], cache.confidences.shape).astype(np.float32)
    return replace(cache, confidences=jnp.clip(cache.confidences * factor, 0.0, 0.95))


def assert_same_scene(told, scene):
    shown = np.asarray(scene.opacities) > 0
    np.testing.assert_array_equal(told.opacities > 0, shown)
    for field in dataclasses.fields(scene):
        np.testing.assert_allclose(
            getattr(told, field.name)[shown],
            np.asarray(getattr(scene, field.name))[shown],
            rtol=HEAD_TOL,
            atol=HEAD_TOL,
        )


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n == "evict" else n for n in CONFIGS])
def test_the_changes_put_together_are_the_scene(name):
    config = CONFIGS[name]
    model, params, rng = StreamSplat(config), decoder_params(config), np.random.default_rng(0)
    cache, feed, told = init_cache(config, CAPACITY), SceneFeed(model, params), None
    decode = jax.jit(model.decode)
    for seed in range(8):
        cache, _ = fuse(cache, chunk(seed), config)
        cache = carved(cache, rng, config)
        if seed in (2, 3):
            continue  # a follower may look away for some chunks
        told = apply_delta(told, feed.update(cache))
        assert_same_scene(told, decode(params, cache))
    assert (told.opacities > 0).any() and (told.opacities == 0).any()


def test_only_what_changed_is_told():
    model, params = StreamSplat(CONFIG), decoder_params(CONFIG)
    feed, cache = SceneFeed(model, params), init_cache(CONFIG, CAPACITY)
    assert len(feed.update(cache).rows) == 0
    cache, touched = fuse(cache, chunk(1), CONFIG)
    assert set(feed.update(cache).rows) == set(np.asarray(touched.rows)[: int(touched.num_rows)])
    assert len(feed.update(cache).rows) == 0
    row = int(jnp.argmax(jnp.max(cache.confidences, axis=1)))
    sunk = replace(cache, confidences=cache.confidences.at[row].set(0.1))
    assert feed.update(sunk).rows.tolist() == [row]
    assert feed.update(cache).rows.tolist() == [row]


def test_a_follower_that_knows_a_cache_is_told_the_rest():
    model, params = StreamSplat(CONFIG), decoder_params(CONFIG)
    known, _ = fuse(init_cache(CONFIG, CAPACITY), chunk(0), CONFIG)
    cache, touched = fuse(jax.tree.map(jnp.copy, known), chunk(1), CONFIG)
    delta = SceneFeed(model, params, known).update(cache)
    assert set(delta.rows) == set(np.asarray(touched.rows)[: int(touched.num_rows)])
    whole = apply_delta(None, SceneFeed(model, params).update(cache))
    told = apply_delta(apply_delta(None, SceneFeed(model, params).update(known)), delta)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=HEAD_TOL, atol=HEAD_TOL), told, whole)


def test_a_cache_that_grows_is_followed():
    model, params = StreamSplat(CONFIG), decoder_params(CONFIG)
    feed, cache = SceneFeed(model, params), init_cache(CONFIG, CAPACITY)
    cache, _ = fuse(cache, chunk(1), CONFIG)
    told = apply_delta(None, feed.update(cache))
    cache, _ = fuse(grow(cache, 2 * CAPACITY), chunk(3), CONFIG)
    told = apply_delta(told, feed.update(cache))
    assert told.num_gaussians == 2 * CAPACITY * CONFIG.memory.pivots_per_voxel * CONFIG.head.gaussians_per_token
    assert_same_scene(told, jax.jit(model.decode)(params, cache))


def test_changes_come_back_from_disk_to_the_last_bit(tmp_path):
    model, params = StreamSplat(CONFIG), decoder_params(CONFIG)
    cache, _ = fuse(init_cache(CONFIG, CAPACITY), chunk(1), CONFIG)
    delta = SceneFeed(model, params).update(cache)
    save_delta(tmp_path / "00000.npz", delta)
    read = load_delta(tmp_path / "00000.npz")
    assert read.capacity == delta.capacity
    np.testing.assert_array_equal(read.rows, delta.rows)
    jax.tree.map(np.testing.assert_array_equal, read.gaussians, delta.gaussians)
    contents = bytearray((tmp_path / "00000.npz").read_bytes())
    contents[len(contents) // 2] ^= 1
    (tmp_path / "00000.npz").write_bytes(contents)
    with pytest.raises(StorageError, match="corrupt"):
        load_delta(tmp_path / "00000.npz")
