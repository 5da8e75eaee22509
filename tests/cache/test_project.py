"""The projection equals the NumPy reference and sees the front surface of each pixel."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from ssplat_jax.cache.project import coarsen, project
from ssplat_jax.cache.votes import carve, observe
from ssplat_jax.core.pytree import replace
from tests.cache import numpy_reference as reference
from tests.cache import projection_scenes as scenes
from tests.cache.streams import CAPACITY, CONFIG, VALUE_RTOL

jit_project = jax.jit(project, static_argnums=2)
PLAIN_MEAN = CONFIG.replace(front_cluster=False)


@pytest.mark.parametrize("config", [CONFIG, PLAIN_MEAN], ids=["cluster", "plain_mean"])
@scenes.SETTINGS
@given(scene_seed=scenes.SEED, camera_seed=scenes.SEED, num_voxels=st.integers(0, CAPACITY), depth_spread=scenes.DEPTHS)
def test_projection_equals_the_reference(config, scene_seed, camera_seed, num_voxels, depth_spread):
    cache, camera = scenes.scene(scene_seed, num_voxels, depth_spread), scenes.cameras(camera_seed)
    depths, confidences, feats, mask, colors, margin = reference.project(
        reference.from_arrays(cache), camera.viewmats, camera.Ks, camera.height, camera.width, config
    )
    assume(margin > scenes.DECISION_MARGIN)
    result = jit_project(cache, camera, config)
    for name, wanted in (("depths", depths), ("confidences", confidences), ("feats", feats), ("colors", colors)):
        scale = np.abs(wanted).max(initial=1e-30)
        np.testing.assert_allclose(getattr(result, name) / scale, wanted / scale, rtol=0, atol=VALUE_RTOL, err_msg=name)
    np.testing.assert_array_equal(result.mask, mask)


@pytest.mark.parametrize("z", [-2.0, 0.0, 0.005, 0.01])
def test_a_pivot_behind_the_near_plane_is_invisible(z):
    assert not np.any(jit_project(scenes.with_pivots([[0.0, 0.0, z]]), scenes.front_camera(), CONFIG).mask)


@pytest.mark.parametrize(("place", "is_seen"), [((4.0, 0.0), True), ((8.0, 0.0), False), ((4.0, 6.0), False),
                                                ((0.0, 3.0), True), ((4.0, -0.01), False)])  # fmt: skip
def test_pixels_hold_their_left_and_upper_edges(place, is_seen):
    """A pivot on the right or lower border of one view must not show in the next one."""
    one = scenes.front_camera()
    camera = jax.tree.map(lambda x: jnp.concatenate([x, x]), one)
    K = np.asarray(one.Ks[0])
    x, y = ((place[i] - K[i, 2]) / K[i, i] * 2.0 for i in (0, 1))
    found = np.argwhere(np.asarray(jit_project(scenes.with_pivots([[x, y, 2.0]]), camera, CONFIG).mask)).tolist()
    row, column = int(place[1]), int(place[0])
    assert found == ([[0, row, column], [1, row, column]] if is_seen else [])


def test_recentering_removes_the_bias_towards_the_camera():
    """The nearest of many noisy samples lies far in front of their surface; the cluster's mean must not."""
    rng, biases = np.random.default_rng(0), []
    for _ in range(60):
        depths = 2.0 * np.exp(0.05 * rng.normal(size=CAPACITY))
        means = np.stack([np.zeros(CAPACITY), np.zeros(CAPACITY), depths], axis=-1)
        seen = jit_project(scenes.with_pivots(means), scenes.front_camera(), CONFIG)
        biases.append(float(seen.depths[0, 3, 4]) / 2.0 - 1.0)
    assert abs(np.mean(biases)) < 0.005  # -2 % without re-centering; 60 x 16 samples give +-0.2 %


def test_no_gradient_passes_the_projection():
    def loss(means, viewmats):
        camera = replace(scenes.cameras(1), viewmats=viewmats)
        result = project(replace(scenes.scene(2, CAPACITY, 1.0), means=means), camera, CONFIG)
        return jnp.sum(result.depths) + jnp.sum(result.feats)

    grads = jax.jit(jax.grad(loss, argnums=(0, 1)))(scenes.scene(2, CAPACITY, 1.0).means, scenes.cameras(1).viewmats)
    assert not any(np.any(np.asarray(g)) for g in grads)


def test_a_coarse_cell_equals_its_nearest_fine_cell():
    fine = jit_project(scenes.scene(5, CAPACITY, 0.3), scenes.cameras(6), CONFIG)
    assert coarsen(fine, 1) is fine
    coarse = jax.jit(coarsen, static_argnums=1)(fine, 2)
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


def test_the_size_of_blocks_changes_nothing(monkeypatch):
    """Blocks so small that rows and pairs take many of them, the last one partly empty."""
    cache, camera = scenes.scene(7, CAPACITY - 3, 0.1), scenes.cameras(8)
    cells = scenes.cells_of(*scenes.random_views(8))

    def passes(cache):
        carved = carve(cache, camera, cells, CONFIG).confidences
        return project(cache, camera, CONFIG), carved, observe(cache, camera, cells, CONFIG).observations

    whole = jax.jit(passes)(cache)
    assert np.any(whole[1] != cache.confidences) and np.any(whole[2] != 0)
    monkeypatch.setattr("ssplat_jax.cache.project.ROWS_PER_BLOCK", 4)
    monkeypatch.setattr("ssplat_jax.cache.project.PAIRS_PER_BLOCK", 7)
    blocks = jax.jit(lambda cache: passes(cache))(cache)
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=VALUE_RTOL, atol=4 * VALUE_RTOL), blocks, whole)
