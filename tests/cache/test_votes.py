"""Votes and observations of views equal the NumPy reference, and stay within their limits."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from ssplat_jax.cache.state import NUM_OBSERVED, STORED_CELLS, init_cache
from ssplat_jax.cache.votes import carve, observation_features, observe, store_depths, vote
from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.pytree import replace
from tests.cache import numpy_reference as reference
from tests.cache import projection_scenes as scenes
from tests.cache.streams import CAPACITY, CONFIG, Recipe, fuse, to_jax, tokens_at

EMPTY = init_cache(CONFIG, CAPACITY)
SHAPE = (1, scenes.HEIGHT, scenes.GRID_WIDTH)
TAU = float(np.float32(CONFIG.memory.min_confidence))
jit_vote = jax.jit(vote, static_argnums=2)


@jax.jit
def told(cache, camera, cells):
    """The cache after the cells of views voted on its pivots, and after they were observed."""
    return carve(cache, camera, cells, CONFIG), observe(cache, camera, cells, CONFIG)


def seen(depth: float, confidence: float = 0.8, color: float = 0.5):
    """Cells of the front camera, all alike."""
    return scenes.cells_of(jnp.full(SHAPE, depth), jnp.full(SHAPE, confidence), jnp.full((*SHAPE, 3), color))


@jax.jit
def after_chunk(cache, camera, cells):
    """The cache after a chunk was counted and its depths stored."""
    stats = replace(cache.stats, num_chunks=cache.stats.num_chunks + 1)
    return store_depths(replace(cache, stats=stats), camera, cells)


def confidence_after(pivot_depth: float, *views, start: float = 0.6) -> float:
    """Confidence of one pivot on the axis of the front camera after `views`."""
    cache = scenes.with_pivots([[0.0, 0.0, pivot_depth]], confidences=[start])
    for cells in views:
        cache, _ = told(cache, scenes.front_camera(), cells)
    return float(cache.confidences[0, 0])


def voted(mean, cells=None, confidence=0.6, valid=True) -> float:
    """Confidence of a token after one chunk whose view saw a wall, at depth 2 by default."""
    cache = after_chunk(EMPTY, scenes.front_camera(), cells or seen(2.0))
    token = tokens_at([mean], [confidence], valid=[valid])
    return float(jit_vote(cache.stored_depths, token, CONFIG).confidences[0])


def random_scene(seed: int, num_voxels: int = CAPACITY, depth_spread: float = 1.0):
    """A cache whose pivots have random footprints, and depths, confidences and colors of two views."""
    cache, rng = scenes.scene(seed, num_voxels, depth_spread), np.random.default_rng(seed + 1)
    sizes = jnp.asarray(rng.uniform(0.05, 0.5, cache.footprints.shape), jnp.float32)
    depths, confidences = scenes.random_views(seed)
    colors = rng.uniform(size=(*depths.shape, 3)).astype(np.float32)
    return replace(cache, footprints=jnp.where(cache.alive, sizes, 0.0)), (depths, confidences, colors)


@scenes.SETTINGS
@given(seed=scenes.SEED, num_voxels=st.integers(0, CAPACITY), depth_spread=scenes.DEPTHS)
def test_votes_on_pivots_and_observations_equal_the_reference(seed, num_voxels, depth_spread):
    (cache, views), camera = random_scene(seed, num_voxels, depth_spread), scenes.cameras(seed)
    carved, observed = reference.from_arrays(cache), reference.from_arrays(cache)
    margin = reference.carve(carved, camera.viewmats, camera.Ks, *views[:2], CONFIG)
    margin = min(margin, reference.observe(observed, camera.viewmats, camera.Ks, *views, CONFIG))
    assume(margin > scenes.DECISION_MARGIN)
    by_votes, by_views = told(cache, camera, scenes.cells_of(*views))
    for row, ((_, voted_on), (_, pivots)) in enumerate(zip(carved["rows"], observed["rows"], strict=True)):
        expected = [pivot["confidences"] for pivot in voted_on]
        np.testing.assert_allclose(by_votes.confidences[row, : len(pivots)], expected, rtol=2e-6)
        expected = [pivot["observations"] for pivot in pivots]
        np.testing.assert_allclose(by_views.observations[row, : len(pivots)], expected, rtol=1e-4, atol=1e-4)
    jax.tree.map(np.testing.assert_array_equal, replace(by_votes, confidences=cache.confidences), cache)
    jax.tree.map(np.testing.assert_array_equal, replace(by_views, observations=cache.observations), cache)
    assert not np.asarray(by_views.observations)[~np.asarray(cache.alive)].any()


@settings(scenes.SETTINGS, max_examples=6)  # two chunks each, also in the slow reference
@given(seed=scenes.SEED, camera_seed=scenes.SEED, size=st.sampled_from([(scenes.HEIGHT, scenes.GRID_WIDTH), (40, 33)]))
def test_votes_on_tokens_equal_the_reference(seed, camera_seed, size):
    height, width = size
    cache, views, rng = EMPTY, [], np.random.default_rng(seed)
    for chunk in range(2):
        camera = scenes.cameras(camera_seed + chunk)
        scale = jnp.array([width / scenes.GRID_WIDTH, height / scenes.HEIGHT, 1.0])[:, None]
        camera = Camera(viewmats=camera.viewmats, Ks=camera.Ks * scale, width=width, height=height)
        depths, confidences = scenes.random_views(seed + chunk, height, width)
        cache = after_chunk(cache, camera, scenes.cells_of(depths, confidences))
        views.append(reference.stored_depths(camera.viewmats, camera.Ks, depths, confidences, STORED_CELLS, CONFIG))
        viewmat, K, nearest, _, weights = views[-1]
        stored = jax.tree.map(lambda x, chunk=chunk: x[chunk], cache.stored_depths)
        np.testing.assert_array_equal(stored.viewmats, viewmat)
        np.testing.assert_allclose(stored.Ks, K, rtol=1e-6)
        np.testing.assert_allclose(stored.weights, weights, rtol=1e-6)
        np.testing.assert_allclose(stored.log_depths[weights > 0], nearest[weights > 0], atol=1e-6)
    tokens = tokens_at(
        rng.uniform(-1, 1, (200, 3)), rng.choice([0.2, 0.4, 0.6, 0.9], 200), valid=rng.uniform(size=200) < 0.9
    )
    arrays = {name: np.asarray(getattr(tokens, name)) for name in ("means", "confidences", "valid")}
    wanted, margin = reference.vote(views, arrays, CONFIG)
    assume(margin > scenes.DECISION_MARGIN / 4)  # smaller than elsewhere: 400 pairs hardly ever keep the full margin
    got = jit_vote(cache.stored_depths, tokens, CONFIG)
    np.testing.assert_allclose(got.confidences, wanted, rtol=2e-5)
    jax.tree.map(np.testing.assert_array_equal, replace(got, confidences=tokens.confidences), tokens)


def test_confidences_stay_revisable():
    sunk = [seen(2.0, 1.0)] * 50
    assert confidence_after(1.0, *sunk) == pytest.approx(0.02)
    assert confidence_after(1.0, *sunk, *[seen(1.0, 1.0)] * 20) > 0.5
    assert confidence_after(1.0, *[seen(1.0, 1.0)] * 50) == pytest.approx(0.95)


def test_an_untrusted_neighbor_forbids_carving_but_not_agreement():
    for row, column in ((2, 3), (3, 5), (4, 4)):
        cells = scenes.cells_of(jnp.full(SHAPE, 2.0), jnp.full(SHAPE, 0.8).at[0, row, column].set(0.1))
        assert confidence_after(1.0, cells) == np.float32(0.6)
        assert confidence_after(2.0, cells) > 0.6


def test_tokens_are_revised_as_pivots_are():
    assert voted([0, 0, 1.9]) < 0.6 < voted([0, 0, 1.99]) and voted([0, 0, 2.1]) > 0.6
    unchanged = np.float32(0.6)
    for mean in ([0, 0, 3.0], [0, 0, -1.0], [5.0, 0, 1.0], [0, 0, np.nan], [0, np.inf, 1.0]):  # hidden or unseen
        assert voted(mean) == unchanged
    assert voted([0, 0, 1.0], valid=False) == unchanged
    assert voted([0, 0, 1.0], confidence=0.2) == np.float32(0.2)  # below tau: it never enters the cache
    assert np.isnan(voted([0, 0, 1.0], confidence=np.nan))


@pytest.mark.parametrize(
    ("confidence", "depth", "weight", "wanted"),
    [
        (0.0, 2.0, 1.0, None),
        (1.0, 2.0, 1.0, 0.72),  # held to 0.95, then odds / e^2
        (1.0, 1.0, 1.0, 0.95),
        (1e-37, 1.0, 1.0, 0.0326),  # held to 0.02, then odds x e^0.5
        (0.6, 2.0, 0.0, None),
        (0.6, 2.0, np.nextafter(np.float32(TAU), np.float32(0)), None),
        (0.6, 2.0, np.nan, None),
        (0.6, 2.0, TAU, 0.4515),
        (0.6, 1e-30, 1.0, None),  # hidden behind a surface on the camera
        (0.6, np.inf, 1.0, None),
        (0.6, np.nan, 1.0, None),
        (0.6, -1.0, 1.0, None),
        (0.6, 1e30, 1.0, 0.1687),
    ],
)
def test_hard_votes_on_a_pivot_and_a_token_at_depth_1(confidence, depth, weight, wanted):
    pivot = confidence_after(1.0, seen(depth, weight), start=confidence)
    token = voted([0, 0, 1.0], seen(depth, weight), confidence=confidence)
    unchanged = float(np.float32(confidence))
    assert pivot == (unchanged if wanted is None else pytest.approx(wanted, rel=2e-3))
    assert token == (unchanged if wanted is None or confidence < TAU else pytest.approx(wanted, rel=2e-3))


def test_the_best_view_is_stored_and_the_oldest_chunk_replaced(monkeypatch):
    monkeypatch.setattr("ssplat_jax.cache.state.NUM_STORED", 2)
    cache, camera = init_cache(CONFIG, CAPACITY), scenes.cameras(3)
    for chunk in range(3):
        depths = np.full((2, scenes.HEIGHT, scenes.GRID_WIDTH), 2.0 + chunk, np.float32)
        confidences = np.full_like(depths, 0.8)
        confidences[1 - chunk % 2, 0, 0] = 0.0  # so that the other view has one trusted cell more
        cache = after_chunk(cache, camera, scenes.cells_of(depths, confidences))
        np.testing.assert_array_equal(cache.stored_depths.viewmats[chunk % 2], camera.viewmats[chunk % 2])
    np.testing.assert_allclose(np.exp(cache.stored_depths.log_depths.max(axis=(1, 2))), [4.0, 3.0], rtol=1e-6)
    after = after_chunk(cache, scenes.front_camera(), seen(3.0, 0.0))  # as padding: it displaces nothing
    jax.tree.map(np.testing.assert_array_equal, after.stored_depths, cache.stored_depths)


def test_without_carving_nothing_is_computed():
    off = CONFIG.replace(carving=False)
    cache, token = init_cache(off, CAPACITY), tokens_at([[0, 0, 1.0]], [0.6])
    assert cache.stored_depths.weights.size == 0
    assert not jax.make_jaxpr(lambda *args: carve(*args, off))(cache, scenes.front_camera(), seen(2.0)).eqns
    assert not jax.make_jaxpr(lambda *args: vote(*args, off))(cache.stored_depths, token).eqns
    assert not jax.make_jaxpr(store_depths)(cache, scenes.front_camera(), seen(2.0)).eqns


def test_shards_see_what_the_whole_cache_sees():
    """Pivots of other shards crowd a cell too."""
    (whole, views), camera = random_scene(0, depth_spread=0.1), scenes.cameras(0)
    cells, half = scenes.cells_of(*views), CAPACITY // 2
    rolled = [jax.tree.map(lambda x, i=i: np.roll(x, -i * half, axis=0) if x.ndim else x, whole) for i in range(2)]
    parts = [
        replace(
            jax.device_put(x),
            num_voxels=jnp.asarray(half),
            counts=jnp.asarray(np.where(np.arange(CAPACITY) < half, x.counts, 0)),
        )
        for x in rolled
    ]
    shards = jax.tree.map(lambda *x: jax.device_put(np.stack(x)), *parts)
    of_shard = lambda cache: observe(cache, camera, cells, CONFIG, axis="shards")  # noqa: E731
    got = jax.jit(jax.vmap(of_shard, axis_name="shards"))(shards)
    wanted = told(whole, camera, cells)[1].observations
    # Column 6 counts the others of a cell.
    assert np.abs(wanted[..., 6]).max() > 0.1
    np.testing.assert_allclose(got.observations[:, :half].reshape(wanted.shape), wanted, rtol=1e-4, atol=1e-5)


def test_merges_keep_all_observations():
    """New pivots have none and merged ones add theirs up, so the sum over all pivots stays."""
    tokens = [to_jax(Recipe(seed, "one_voxel", "normal", "random").tokens()) for seed in range(2)]
    cache = fuse(init_cache(CONFIG, CAPACITY), tokens[0], CONFIG)
    assert not np.asarray(cache.observations).any()
    sums = np.random.default_rng(0).uniform(size=cache.observations.shape) * np.asarray(cache.alive)[..., None]
    cache = fuse(replace(cache, observations=jnp.asarray(sums, jnp.float32)), tokens[1], CONFIG)
    assert int(cache.stats.num_merged) > 0
    np.testing.assert_allclose(cache.observations.sum(axis=(0, 1)), sums.sum(axis=(0, 1)), rtol=1e-5)


def test_features_are_finite_and_pass_no_gradient():
    packed = jnp.array([[0.0], [1.0], [1e6]]) * jnp.ones(NUM_OBSERVED)
    assert np.isfinite(observation_features(packed)).all()
    assert not np.any(jax.jit(jax.grad(lambda x: observation_features(x).sum()))(packed))
