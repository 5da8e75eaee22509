"""The projection equals the NumPy reference and sees the front surface of each pixel."""

import functools
import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from ssplat_jax.cache import coarsen, init_cache, pixel_pairs, project
from ssplat_jax.cache import numpy_reference as reference
from ssplat_jax.core.pytree import replace
from tests.cache.projection_scenes import (
    DECISION_MARGIN,
    DEPTHS,
    SEED,
    SETTINGS,
    cameras,
    front_camera,
    scene,
    with_pivots,
)
from tests.cache.streams import CAPACITY, CONFIG, VALUE_RTOL, WIDTH

jit_project = jax.jit(project, static_argnums=2)
PLAIN_MEAN = CONFIG.replace(front_cluster=False)


def assert_equal_to_reference(cache, camera, config):
    depths, confidences, feats, mask, colors, margin = reference.project(
        reference.from_arrays(cache), camera.viewmats, camera.Ks, camera.height, camera.width, config
    )
    assume(margin > DECISION_MARGIN)
    result = jit_project(cache, camera, config)
    np.testing.assert_array_equal(result.mask, mask)
    for name, wanted in (("depths", depths), ("confidences", confidences), ("feats", feats), ("colors", colors)):
        scale = np.abs(wanted).max(initial=1e-30)
        np.testing.assert_allclose(getattr(result, name) / scale, wanted / scale, rtol=0, atol=VALUE_RTOL, err_msg=name)


@pytest.mark.parametrize("config", [CONFIG, PLAIN_MEAN], ids=["cluster", "plain_mean"])
@SETTINGS
@given(scene_seed=SEED, camera_seed=SEED, num_voxels=st.integers(0, CAPACITY), depth_spread=DEPTHS)
def test_projection_equals_the_reference(config, scene_seed, camera_seed, num_voxels, depth_spread):
    assert_equal_to_reference(scene(scene_seed, num_voxels, depth_spread), cameras(camera_seed), config)


@pytest.mark.slow
@settings(SETTINGS, max_examples=2000)
@given(scene_seed=SEED, camera_seed=SEED, num_voxels=st.integers(0, CAPACITY), depth_spread=DEPTHS)
def test_projection_equals_the_reference_on_many_scenes(scene_seed, camera_seed, num_voxels, depth_spread):
    assert_equal_to_reference(scene(scene_seed, num_voxels, depth_spread), cameras(camera_seed), CONFIG)


def test_single_pivot_fills_its_pixel_only():
    result = jit_project(with_pivots([[0.0, 0.0, 2.0]]), front_camera(), CONFIG)
    assert np.argwhere(np.asarray(result.mask)).tolist() == [[0, 3, 4]]
    assert result.depths[0, 3, 4] == pytest.approx(2.0, rel=VALUE_RTOL)
    assert result.confidences[0, 3, 4] == 0.5
    np.testing.assert_array_equal(result.feats[0, 3, 4], np.ones(WIDTH))
    for x in (result.depths, result.confidences, result.feats, result.colors):
        assert not np.any(np.asarray(x)[~np.asarray(result.mask)])


@pytest.mark.parametrize("z", [-2.0, 0.0, 0.01])
def test_pivot_behind_the_near_plane_is_invisible(z):
    assert not np.any(jit_project(with_pivots([[0.0, 0.0, z]]), front_camera(), CONFIG).mask)


@pytest.mark.parametrize(("place", "is_seen"), [((4.0, 0.0), True), ((8.0, 0.0), False), ((4.0, 6.0), False),
                                                ((0.0, 3.0), True), ((4.0, -0.01), False)])  # fmt: skip
def test_pixels_hold_their_left_and_upper_edges(place, is_seen):
    """A pivot on the right or lower border of one view must not show in the next one."""
    one = front_camera()
    camera = jax.tree.map(lambda x: jnp.concatenate([x, x]), one)
    K = np.asarray(one.Ks[0])
    x, y = ((place[i] - K[i, 2]) / K[i, i] * 2.0 for i in (0, 1))
    found = np.argwhere(np.asarray(jit_project(with_pivots([[x, y, 2.0]]), camera, CONFIG).mask)).tolist()
    row, column = int(place[1]), int(place[0])
    assert found == ([[0, row, column], [1, row, column]] if is_seen else [])


def test_pivot_of_confidence_zero_occludes_nothing():
    cache = with_pivots([[0.0, 0.0, 1.0], [0.0, 0.0, 3.0]], confidences=[0.0, 0.5])
    assert jit_project(cache, front_camera(), CONFIG).depths[0, 3, 4] == pytest.approx(3.0, rel=VALUE_RTOL)


def test_front_surface_is_seen():
    result = jit_project(with_pivots([[0.0, 0.0, 4.0], [0.0, 0.0, 2.0], [0.0, 0.0, 2.1]]), front_camera(), CONFIG)
    assert result.depths[0, 3, 4] == pytest.approx(np.sqrt(2.0 * 2.1), rel=VALUE_RTOL)  # the mean of logs
    np.testing.assert_allclose(result.feats[0, 3, 4], 2.5, rtol=VALUE_RTOL)


def test_plain_mean_mixes_the_surfaces():
    result = jit_project(with_pivots([[0.0, 0.0, 4.0], [0.0, 0.0, 1.0]]), front_camera(), PLAIN_MEAN)
    assert result.depths[0, 3, 4] == pytest.approx(2.0, rel=VALUE_RTOL)


def test_recentering_removes_the_bias_towards_the_camera():
    """The nearest of many noisy samples lies far in front of their surface; the cluster's mean must not."""
    rng = np.random.default_rng(0)
    biases = []
    for _ in range(60):
        depths = 2.0 * np.exp(0.05 * rng.normal(size=CAPACITY))
        means = np.stack([np.zeros(CAPACITY), np.zeros(CAPACITY), depths], axis=-1)
        biases.append(float(jit_project(with_pivots(means), front_camera(), CONFIG).depths[0, 3, 4]) / 2.0 - 1.0)
    assert abs(np.mean(biases)) < 0.005  # -2 % without re-centering; 60 x 16 samples give +-0.2 %


def test_permuted_pivots_give_the_same_maps():
    cache, camera = scene(3, CAPACITY, 1.0), cameras(4)
    order = np.random.default_rng(0).permutation(CAPACITY)
    names = ("counts", "means", "confidences", "feats")
    permuted = replace(cache, **{name: getattr(cache, name)[order] for name in names})
    a, b = (jit_project(c, camera, CONFIG) for c in (cache, permuted))
    np.testing.assert_array_equal(a.mask, b.mask)
    for name in ("depths", "confidences", "feats"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=0, atol=4 * VALUE_RTOL)


def test_block_size_changes_nothing(monkeypatch):
    """Blocks so small that rows and pairs take many of them, the last one partly empty."""
    cache, camera = scene(7, CAPACITY - 3, 0.1), cameras(8)
    whole = jit_project(cache, camera, CONFIG)
    module = importlib.import_module("ssplat_jax.cache.project")  # the package's `project` is the function
    monkeypatch.setattr(pixel_pairs, "ROWS_PER_BLOCK", 4)
    monkeypatch.setattr(module, "PAIRS_PER_BLOCK", 7)
    blocks = jax.jit(lambda *args: project(*args, CONFIG))(cache, camera)
    np.testing.assert_array_equal(whole.mask, blocks.mask)
    for name in ("depths", "confidences", "feats"):
        np.testing.assert_allclose(getattr(whole, name), getattr(blocks, name), rtol=0, atol=4 * VALUE_RTOL)


def test_pixel_color_is_the_mean_over_parts_and_pivots():
    cache = with_pivots([[0.0, 0.0, 2.0], [0.0, 0.0, 2.1]], confidences=[0.75, 0.5])
    parts = np.arange(24.0).reshape(2, 4, 3)  # pivots, parts of a patch, channels
    cache = replace(cache, rgbs=cache.rgbs.at[:2, 0].set(jnp.asarray(parts.reshape(2, 12), jnp.float32)))
    wanted = 0.6 * parts[0].mean(axis=0) + 0.4 * parts[1].mean(axis=0)
    np.testing.assert_allclose(jit_project(cache, front_camera(), CONFIG).colors[0, 3, 4], wanted, rtol=VALUE_RTOL)


def test_colors_are_projected_only_to_match_exposure():
    cache, camera = with_pivots([[0.0, 0.0, 2.0]]), front_camera()
    for matched in (True, False):
        program = jax.jit(functools.partial(project, config=CONFIG.replace(match_exposure=matched)))
        assert matched == (f"x{WIDTH + 3}xf32" in program.lower(cache, camera).as_text())
    assert project(cache, camera, CONFIG.replace(match_exposure=False)).colors is None


def test_projection_is_deterministic():
    cache, camera = scene(5, CAPACITY, 0.1), cameras(6)
    a, b = (jit_project(cache, camera, CONFIG) for _ in range(2))
    jax.tree.map(np.testing.assert_array_equal, a, b)


def test_empty_cache_projects_to_nothing():
    result = jit_project(init_cache(CONFIG, CAPACITY), cameras(0), CONFIG)
    assert not any(np.any(np.asarray(x)) for x in jax.tree.leaves(result))


def test_no_gradient_passes_the_projection():
    def loss(means, viewmats):
        camera = replace(cameras(1), viewmats=viewmats)
        result = project(replace(scene(2, CAPACITY, 1.0), means=means), camera, CONFIG)
        return jnp.sum(result.depths) + jnp.sum(result.feats)

    grads = jax.grad(loss, argnums=(0, 1))(scene(2, CAPACITY, 1.0).means, cameras(1).viewmats)
    assert not any(np.any(np.asarray(g)) for g in grads)


def test_coarse_cell_equals_its_nearest_fine_cell():
    fine = jit_project(scene(5, CAPACITY, 0.3), cameras(6), CONFIG)
    assert coarsen(fine, 1) is fine
    coarse = coarsen(fine, 2)
    mask, depths = np.asarray(fine.mask), np.asarray(fine.depths)
    assert 0 < mask.mean() < 1
    for v, i, j in np.ndindex(*coarse.depths.shape):
        cells = [(v, 2 * i + y, 2 * j + x) for y, x in np.ndindex(2, 2) if mask[v, 2 * i + y, 2 * j + x]]
        assert bool(coarse.mask[v, i, j]) == bool(cells)
        if not cells:
            assert not any(np.any(np.asarray(x)[v, i, j]) for x in jax.tree.leaves(coarse))
            continue
        nearest = min(cells, key=lambda cell: depths[cell])
        jax.tree.map(lambda c, f: np.testing.assert_array_equal(c[v, i, j], f[nearest]), coarse, fine)  # noqa: B023
