"""Sightings equal the NumPy reference, add up over views, and say nothing where nothing is known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from ssplat_jax.cache import add_sightings, init_cache
from ssplat_jax.cache import numpy_reference as reference
from ssplat_jax.cache.sightings import cells_of, features_of_sightings
from ssplat_jax.cache.state import NUM_SIGHTINGS
from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.pytree import replace
from tests.cache.projection_scenes import (
    DECISION_MARGIN,
    DEPTHS,
    GRID_WIDTH,
    HEIGHT,
    SEED,
    SETTINGS,
    cameras,
    front_camera,
    scene,
    with_pivots,
)
from tests.cache.streams import CAPACITY, CONFIG, Recipe, fuse, to_jax
from tests.cache.test_carve import random_views

ON, BEFORE, BEHIND, ERROR_ON, ERROR_BEFORE, OFFSET, CROWD, RELATIVE, SIZE = range(NUM_SIGHTINGS)
PARTS = CONFIG.head.gaussians_per_token
AXIS_CELL = (0, 3, 4)  # of the front camera


@jax.jit
def seen(cache, camera, depths, confidences, colors):
    """The cache after views of these depths and colors."""
    rgbs = jnp.tile(colors.reshape(-1, 3), (1, PARTS))
    cells = cells_of(depths, confidences, rgbs, CONFIG)
    return add_sightings(cache, camera, cells, CONFIG)


def random_colors(seed: int, shape: tuple[int, ...]):
    """Colors of cells."""
    return np.random.default_rng(seed + 1).uniform(size=(*shape, 3)).astype(np.float32)


def with_footprints(cache, seed: int):
    """`cache` with random footprints of its pivots."""
    sizes = np.random.default_rng(seed).uniform(0.05, 0.5, cache.footprints.shape)
    return replace(cache, footprints=jnp.where(cache.alive, jnp.asarray(sizes, jnp.float32), 0.0))


def of_pivot(depth: float, *, at: float = 2.0, weight: float = 0.8, color: float = 0.5, own: float = 0.5):
    """Sightings of one pivot on the axis of the front camera, whose cells all have one depth and color."""
    cache = with_pivots([[0.0, 0.0, depth]], confidences=[0.6])
    cache = replace(cache, footprints=cache.footprints.at[0, 0].set(0.5), rgbs=cache.rgbs.at[0, 0].set(own))
    shape = (1, HEIGHT, GRID_WIDTH)
    got = seen(cache, front_camera(), jnp.full(shape, at), jnp.full(shape, weight), jnp.full((*shape, 3), color))
    return np.asarray(got.sightings[0, 0])


@SETTINGS
@given(scene_seed=SEED, camera_seed=SEED, num_voxels=st.integers(0, CAPACITY), depth_spread=DEPTHS)
def test_sightings_equal_the_reference(scene_seed, camera_seed, num_voxels, depth_spread):
    cache, camera = with_footprints(scene(scene_seed, num_voxels, depth_spread), scene_seed), cameras(camera_seed)
    depths, confidences = random_views(camera_seed)
    colors = random_colors(camera_seed, depths.shape)
    wanted = reference.from_arrays(cache)
    margin = reference.add_sightings(wanted, camera.viewmats, camera.Ks, depths, confidences, colors, CONFIG)
    assume(margin > DECISION_MARGIN)
    got = seen(cache, camera, *map(jnp.asarray, (depths, confidences, colors)))
    for row, (_, pivots) in enumerate(wanted["rows"]):
        expected = [pivot["sightings"] for pivot in pivots]
        np.testing.assert_allclose(got.sightings[row, : len(pivots)], expected, rtol=1e-4, atol=1e-4)
    jax.tree.map(np.testing.assert_array_equal, replace(got, sightings=cache.sightings), cache)
    assert not np.asarray(got.sightings)[~np.asarray(cache.alive)].any()


def test_a_pivot_on_before_and_behind_the_surface():
    np.testing.assert_allclose(of_pivot(2.0)[[ON, BEFORE, BEHIND]], [0.8, 0, 0], rtol=1e-6)
    np.testing.assert_allclose(of_pivot(1.9)[[ON, BEFORE, BEHIND]], [0, 0.8, 0], rtol=1e-6)
    np.testing.assert_allclose(of_pivot(2.1)[[ON, BEFORE, BEHIND]], [0, 0, 0.8], rtol=1e-6)


def test_errors_count_where_the_pivot_should_show():
    assert of_pivot(2.0, color=0.75)[ERROR_ON] == pytest.approx(0.8 * 0.25, rel=1e-5)
    assert of_pivot(1.9, color=0.75)[ERROR_BEFORE] == pytest.approx(0.8 * 0.25, rel=1e-5)
    assert of_pivot(2.1, color=0.75)[[ERROR_ON, ERROR_BEFORE]].tolist() == [0, 0]


def test_the_offset_is_signed_and_ends_at_one_margin():
    assert of_pivot(2.02)[OFFSET] == pytest.approx(0.8 * np.log(1.01) / np.log(1.03), rel=1e-4)
    assert of_pivot(1.98)[OFFSET] < 0


def test_the_size_compares_the_footprint_with_the_cell():
    """A pivot of 0.5 at depth 2 fills 2 cells of a camera of 8 cells focal length."""
    assert of_pivot(2.0)[SIZE] == pytest.approx(0.8 * np.log(0.5 / (2.0 / 8.0)), rel=1e-5)


def test_pivots_of_one_cell_are_compared_with_each_other():
    """The pivot whose color fits has a negative relative error, the other one on the same surface a positive one."""
    cache = with_pivots([[0.0, 0.0, 2.0], [0.01, 0.0, 2.0]], confidences=[0.6, 0.6])
    cache = replace(cache, rgbs=cache.rgbs.at[0, 0].set(0.5).at[1, 0].set(0.9))
    shape = (1, HEIGHT, GRID_WIDTH)
    got = seen(cache, front_camera(), jnp.full(shape, 2.0), jnp.ones(shape), jnp.full((*shape, 3), 0.5)).sightings
    np.testing.assert_allclose(got[:2, 0, CROWD], np.log(2.0), rtol=1e-5)
    np.testing.assert_allclose(got[:2, 0, RELATIVE], [-0.2, 0.2], rtol=1e-4)


def test_carved_pivots_do_not_crowd_a_cell():
    cache = with_pivots([[0.0, 0.0, 2.0], [0.01, 0.0, 2.0]], confidences=[0.6, 0.1])
    shape = (1, HEIGHT, GRID_WIDTH)
    got = seen(cache, front_camera(), jnp.full(shape, 2.0), jnp.ones(shape), jnp.full((*shape, 3), 0.5)).sightings
    assert float(got[0, 0, CROWD]) == 0.0


@pytest.mark.parametrize("depth", [np.nan, np.inf, 0.0, -1.0])
def test_depths_that_are_no_depths_say_nothing(depth):
    assert not of_pivot(2.0, at=depth).any()


@pytest.mark.parametrize("weight", [0.0, 0.29])
def test_untrusted_cells_say_nothing(weight):
    assert not of_pivot(2.0, weight=weight).any()


@SETTINGS
@given(seed=SEED)
def test_views_add_up(seed):
    """Two views together say what they say one after the other."""
    camera = cameras(seed)
    cache = with_footprints(scene(seed, CAPACITY, 1.0), seed)
    depths, confidences = random_views(seed)
    views = [jnp.asarray(x) for x in (depths, confidences, random_colors(seed, depths.shape))]
    together = seen(cache, camera, *views).sightings
    one_by_one = cache
    for i in range(2):
        one = Camera(viewmats=camera.viewmats[i][None], Ks=camera.Ks[i][None], width=GRID_WIDTH, height=HEIGHT)
        one_by_one = seen(one_by_one, one, *(x[i][None] for x in views))
    np.testing.assert_allclose(together, one_by_one.sightings, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("seed", [0, 2, 4])
def test_shards_see_what_the_whole_cache_sees(seed):
    """Pivots of other shards crowd a cell too."""
    whole, camera = with_footprints(scene(seed, CAPACITY, 0.1), seed), cameras(seed)
    depths, confidences = random_views(seed)
    colors = random_colors(seed, depths.shape)
    rgbs = jnp.tile(jnp.asarray(colors).reshape(-1, 3), (1, PARTS))
    cells = cells_of(jnp.asarray(depths), jnp.asarray(confidences), rgbs, CONFIG)
    half = CAPACITY // 2
    rolled = [jax.tree.map(lambda x, i=i: jnp.roll(x, -i * half, axis=0) if x.ndim else x, whole) for i in range(2)]
    parts = [replace(x, num_voxels=jnp.asarray(half), counts=x.counts.at[half:].set(0)) for x in rolled]
    shards = jax.tree.map(lambda *x: jnp.stack(x), *parts)
    got = jax.vmap(lambda cache: add_sightings(cache, camera, cells, CONFIG, axis="shards"), axis_name="shards")(shards)
    wanted = add_sightings(whole, camera, cells, CONFIG).sightings
    assert np.abs(wanted[..., CROWD]).max() > 0.1
    np.testing.assert_allclose(got.sightings[:, :half].reshape(wanted.shape), wanted, rtol=1e-4, atol=1e-5)


@SETTINGS
@given(seed=SEED)
def test_merges_keep_all_sightings(seed):
    """New pivots have none and merged ones add theirs up, so the sum over all pivots stays."""
    cache = init_cache(CONFIG)
    for i in range(2):
        cache = fuse(cache, to_jax(Recipe(seed + i, "one_voxel", "normal", "random").tokens()), CONFIG)
        if i == 0:
            told = np.random.default_rng(seed).uniform(size=cache.sightings.shape) * np.asarray(cache.alive)[..., None]
            assert not np.asarray(cache.sightings).any() and int(cache.alive.sum()) == CONFIG.memory.pivots_per_voxel
            cache = replace(cache, sightings=jnp.asarray(told, jnp.float32))
    assert int(cache.stats.num_merged) > 0
    np.testing.assert_allclose(cache.sightings.sum(axis=(0, 1)), told.sum(axis=(0, 1)), rtol=1e-5)


@pytest.mark.parametrize("value", [0.0, 1.0, 1e6])
def test_features_are_finite_and_pass_no_gradient(value):
    packed = jnp.full((3, NUM_SIGHTINGS), value)
    assert jnp.isfinite(features_of_sightings(packed)).all()
    assert not jnp.any(jax.grad(lambda x: features_of_sightings(x).sum())(packed))
