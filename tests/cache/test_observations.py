"""Observations equal the NumPy reference, add up over views, and say nothing where nothing is known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from ssplat_jax.cache import init_cache, observe, seen_cells
from ssplat_jax.cache import numpy_reference as reference
from ssplat_jax.cache.observations import observation_features
from ssplat_jax.cache.state import NUM_OBSERVED
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
    random_views,
    scene,
    with_pivots,
)
from tests.cache.streams import CAPACITY, CONFIG, Recipe, fuse, to_jax

ON, BEFORE, BEHIND, ERROR_ON, ERROR_BEFORE, OFFSET, CROWD, RELATIVE, SIZE = range(NUM_OBSERVED)
PARTS = CONFIG.head.gaussians_per_token
SHAPE = (1, HEIGHT, GRID_WIDTH)


@jax.jit
def seen(cache, camera, depths, confidences, colors):
    """The cache after views of these depths and colors."""
    rgbs = jnp.tile(colors.reshape(-1, 3), (1, PARTS))
    return observe(cache, camera, seen_cells(depths, confidences, rgbs, CONFIG), CONFIG)


def random_scene(seed: int, num_voxels: int = CAPACITY, depth_spread: float = 1.0):
    """A cache whose pivots have random footprints, and depths, confidences and colors of two views."""
    cache, rng = scene(seed, num_voxels, depth_spread), np.random.default_rng(seed + 1)
    sizes = jnp.asarray(rng.uniform(0.05, 0.5, cache.footprints.shape), jnp.float32)
    depths, confidences = random_views(seed)
    colors = rng.uniform(size=(*depths.shape, 3)).astype(np.float32)
    return replace(cache, footprints=jnp.where(cache.alive, sizes, 0.0)), (depths, confidences, colors)


def of_pivot(depth: float, *, at: float = 2.0, weight: float = 0.8, color: float = 0.5):
    """Observations of one pivot on the axis of the front camera, whose cells all have one depth and color."""
    cache = with_pivots([[0.0, 0.0, depth]], confidences=[0.6])
    cache = replace(cache, footprints=cache.footprints.at[0, 0].set(0.5), rgbs=cache.rgbs.at[0, 0].set(0.5))
    views = (jnp.full(SHAPE, at), jnp.full(SHAPE, weight), jnp.full((*SHAPE, 3), color))
    return np.asarray(seen(cache, front_camera(), *views).observations[0, 0])


@SETTINGS
@given(seed=SEED, num_voxels=st.integers(0, CAPACITY), depth_spread=DEPTHS)
def test_observations_equal_the_reference(seed, num_voxels, depth_spread):
    (cache, views), camera = random_scene(seed, num_voxels, depth_spread), cameras(seed)
    wanted = reference.from_arrays(cache)
    assume(reference.observe(wanted, camera.viewmats, camera.Ks, *views, CONFIG) > DECISION_MARGIN)
    got = seen(cache, camera, *map(jnp.asarray, views))
    for row, (_, pivots) in enumerate(wanted["rows"]):
        expected = [pivot["observations"] for pivot in pivots]
        np.testing.assert_allclose(got.observations[row, : len(pivots)], expected, rtol=1e-4, atol=1e-4)
    jax.tree.map(np.testing.assert_array_equal, replace(got, observations=cache.observations), cache)
    assert not np.asarray(got.observations)[~np.asarray(cache.alive)].any()


def test_a_pivot_on_before_and_behind_the_surface():
    on, before, behind = (of_pivot(depth, color=0.75) for depth in (2.0, 1.9, 2.1))
    for numbers, place in ((on, ON), (before, BEFORE), (behind, BEHIND)):
        np.testing.assert_allclose(numbers[:3], 0.8 * np.eye(3)[place], rtol=1e-6)
    # Errors count where the pivot should show.
    assert [on[ERROR_ON], before[ERROR_BEFORE]] == pytest.approx([0.8 * 0.25] * 2, rel=1e-5)
    assert behind[[ERROR_ON, ERROR_BEFORE]].tolist() == [0, 0]
    # A pivot of 0.5 at depth 2 fills 2 cells of a camera of 8 cells focal length.
    assert on[SIZE] == pytest.approx(0.8 * np.log(0.5 / (2.0 / 8.0)), rel=1e-5)
    assert of_pivot(2.02)[OFFSET] == pytest.approx(0.8 * np.log(1.01) / np.log(1.03), rel=1e-4)
    assert of_pivot(1.98)[OFFSET] < 0


@pytest.mark.parametrize(("other", "crowd"), [(0.6, np.log(2.0)), (0.1, 0.0)])  # a carved pivot crowds no cell
def test_pivots_of_one_cell_are_compared_with_each_other(other, crowd):
    """The pivot whose color fits has a negative relative error, the other one on the same surface a positive one."""
    cache = with_pivots([[0.0, 0.0, 2.0], [0.01, 0.0, 2.0]], confidences=[0.6, other])
    cache = replace(cache, rgbs=cache.rgbs.at[0, 0].set(0.5).at[1, 0].set(0.9))
    views = (jnp.full(SHAPE, 2.0), jnp.ones(SHAPE), jnp.full((*SHAPE, 3), 0.5))
    got = seen(cache, front_camera(), *views).observations
    assert got[0, 0, CROWD] == pytest.approx(crowd, rel=1e-5)
    if crowd:
        np.testing.assert_allclose(got[:2, 0, RELATIVE], [-0.2, 0.2], rtol=1e-4)


@pytest.mark.parametrize(("depth", "weight"), [(np.nan, 0.8), (np.inf, 0.8), (0.0, 0.8), (2.0, 0.0), (2.0, 0.29)])
def test_untrusted_cells_say_nothing(depth, weight):
    assert not of_pivot(2.0, at=depth, weight=weight).any()


@SETTINGS
@given(seed=SEED)
def test_views_add_up(seed):
    """Two views together say what they say one after the other."""
    (cache, views), camera = random_scene(seed), cameras(seed)
    views = [jnp.asarray(x) for x in views]
    together, one_by_one = seen(cache, camera, *views).observations, cache
    for i in range(2):
        one_by_one = seen(one_by_one, camera[jnp.array([i])], *(x[i][None] for x in views))
    np.testing.assert_allclose(together, one_by_one.observations, rtol=1e-5, atol=1e-5)


def test_shards_see_what_the_whole_cache_sees():
    """Pivots of other shards crowd a cell too."""
    (whole, (depths, confidences, colors)), camera = random_scene(0, depth_spread=0.1), cameras(0)
    rgbs = jnp.tile(jnp.asarray(colors).reshape(-1, 3), (1, PARTS))
    cells, half = seen_cells(jnp.asarray(depths), jnp.asarray(confidences), rgbs, CONFIG), CAPACITY // 2
    rolled = [jax.tree.map(lambda x, i=i: jnp.roll(x, -i * half, axis=0) if x.ndim else x, whole) for i in range(2)]
    parts = [replace(x, num_voxels=jnp.asarray(half), counts=x.counts.at[half:].set(0)) for x in rolled]
    shards = jax.tree.map(lambda *x: jnp.stack(x), *parts)
    got = jax.vmap(lambda cache: observe(cache, camera, cells, CONFIG, axis="shards"), axis_name="shards")(shards)
    wanted = observe(whole, camera, cells, CONFIG).observations
    assert np.abs(wanted[..., CROWD]).max() > 0.1
    np.testing.assert_allclose(got.observations[:, :half].reshape(wanted.shape), wanted, rtol=1e-4, atol=1e-5)


def test_merges_keep_all_observations():
    """New pivots have none and merged ones add theirs up, so the sum over all pivots stays."""
    tokens = [to_jax(Recipe(seed, "one_voxel", "normal", "random").tokens()) for seed in range(2)]
    cache = fuse(init_cache(CONFIG, CAPACITY), tokens[0], CONFIG)
    assert not np.asarray(cache.observations).any()
    told = np.random.default_rng(0).uniform(size=cache.observations.shape) * np.asarray(cache.alive)[..., None]
    cache = fuse(replace(cache, observations=jnp.asarray(told, jnp.float32)), tokens[1], CONFIG)
    assert int(cache.stats.num_merged) > 0
    np.testing.assert_allclose(cache.observations.sum(axis=(0, 1)), told.sum(axis=(0, 1)), rtol=1e-5)


@pytest.mark.parametrize("value", [0.0, 1.0, 1e6])
def test_features_are_finite_and_pass_no_gradient(value):
    packed = jnp.full((3, NUM_OBSERVED), value)
    assert jnp.isfinite(observation_features(packed)).all()
    assert not jnp.any(jax.grad(lambda x: observation_features(x).sum())(packed))
