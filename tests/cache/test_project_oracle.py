"""The projection against its NumPy oracle, and ALGORITHM.md section 12, point 6."""

import functools
import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from ssplat_jax.cache import VoxelCache, coarser, init_cache, project
from ssplat_jax.cache import numpy_reference as reference
from ssplat_jax.geometry.cameras import Camera
from ssplat_jax.pytree import replace
from tests.cache.streams import CAPACITY, CONFIG, VALUE_RTOL, WIDTH

HEIGHT, GRID_WIDTH = 6, 8
DECISION_MARGIN = 1e-4  # pixels, log depths: no float32 rounding of the inputs below moves a decision this far

jit_project = jax.jit(project, static_argnums=2)
LITERAL = CONFIG.replace(cluster_ratio=float("inf"))


def cameras(seed: int, num_views: int = 2) -> Camera:
    """Cameras around (0, 0, -4) that look along +z, with different intrinsics."""
    rng = np.random.default_rng(seed)
    viewmats = np.tile(np.eye(4), (num_views, 1, 1))
    for viewmat in viewmats:
        q, _ = np.linalg.qr(np.eye(3) + 0.2 * rng.normal(size=(3, 3)))
        viewmat[:3, :3] = q * np.sign(np.diagonal(q))
        viewmat[:3, 3] = rng.uniform(-0.3, 0.3, 3) + np.array([0, 0, 4])
    Ks = np.tile([[9.0, 0, 4.3], [0, 8.0, 2.8], [0, 0, 1]], (num_views, 1, 1)) * rng.uniform(
        0.9, 1.1, (num_views, 1, 1)
    )
    Ks[:, 2, 2] = 1
    return Camera(
        viewmats=jnp.asarray(viewmats, jnp.float32), Ks=jnp.asarray(Ks, jnp.float32), width=GRID_WIDTH, height=HEIGHT
    )


def scene(seed: int, num_voxels: int, depth_spread: float) -> VoxelCache:
    """A cache of random pivots about the origin, `depth_spread` deep, crowded on few pixels."""
    rng = np.random.default_rng(seed)
    cache = init_cache(CONFIG, CAPACITY)
    k = CONFIG.memory.pivots_per_voxel
    counts = np.where(np.arange(CAPACITY) < num_voxels, rng.integers(1, k + 1, CAPACITY), 0)
    alive = np.arange(k) < counts[:, None]
    means = rng.uniform(-1, 1, (CAPACITY, k, 3)) * [1.0, 1.0, depth_spread]
    values = {
        "means": means * alive[..., None],
        "confidences": rng.choice([0.0, 0.3, 0.5, 1.0], (CAPACITY, k)) * alive,
        "feats": rng.normal(size=(CAPACITY, k, WIDTH)) * alive[..., None],
        "rgbs": rng.uniform(size=(CAPACITY, k, 3 * CONFIG.head.gaussians_per_token)) * alive[..., None],
    }
    return replace(
        cache,
        counts=jnp.asarray(counts, jnp.int32),
        num_voxels=jnp.asarray(num_voxels, jnp.int32),
        **{name: jnp.asarray(x, jnp.float32) for name, x in values.items()},
    )


def assert_equal_to_oracle(cache, camera, config):
    depths, confidences, feats, mask, colors, margin = reference.project(
        reference.from_arrays(cache), camera.viewmats, camera.Ks, camera.height, camera.width, config
    )
    assume(margin > DECISION_MARGIN)
    result = jit_project(cache, camera, config)
    np.testing.assert_array_equal(result.mask, mask)
    for name, wanted in (("depths", depths), ("confidences", confidences), ("feats", feats), ("colors", colors)):
        scale = np.abs(wanted).max(initial=1e-30)
        np.testing.assert_allclose(getattr(result, name) / scale, wanted / scale, rtol=0, atol=VALUE_RTOL, err_msg=name)


SETTINGS = settings(max_examples=60, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
SEED = st.integers(0, 2**32 - 1)
DEPTHS = st.sampled_from([0.1, 0.5, 1.0, 6.0])  # 6: some pivots are behind the cameras


@pytest.mark.parametrize("config", [CONFIG, LITERAL], ids=["cluster", "plain_mean"])
@SETTINGS
@given(scene_seed=SEED, camera_seed=SEED, num_voxels=st.integers(0, CAPACITY), depth_spread=DEPTHS)
def test_projection_equals_the_loop(config, scene_seed, camera_seed, num_voxels, depth_spread):
    assert_equal_to_oracle(scene(scene_seed, num_voxels, depth_spread), cameras(camera_seed), config)


@pytest.mark.slow
@settings(SETTINGS, max_examples=2000)
@given(scene_seed=SEED, camera_seed=SEED, num_voxels=st.integers(0, CAPACITY), depth_spread=DEPTHS)
def test_projection_equals_the_loop_on_2000_scenes(scene_seed, camera_seed, num_voxels, depth_spread):
    assert_equal_to_oracle(scene(scene_seed, num_voxels, depth_spread), cameras(camera_seed), CONFIG)


def with_pivots(means, confidences=None) -> VoxelCache:
    """A cache of one pivot per row at `means`; features number the pivots."""
    n = len(means)
    cache = init_cache(CONFIG, CAPACITY)
    confidences = np.full(n, 0.5) if confidences is None else confidences
    return replace(
        cache,
        counts=cache.counts.at[:n].set(1),
        num_voxels=jnp.asarray(n, jnp.int32),
        means=cache.means.at[:n, 0].set(jnp.asarray(means, jnp.float32)),
        confidences=cache.confidences.at[:n, 0].set(jnp.asarray(confidences, jnp.float32)),
        feats=cache.feats.at[:n, 0].set(jnp.arange(1.0, n + 1)[:, None] * jnp.ones(WIDTH)),
    )


def front_camera() -> Camera:
    """At the origin, looking along +z, principal point in the middle of pixel (3, 4)."""
    K = jnp.array([[8.0, 0, 4.5], [0, 8.0, 3.5], [0, 0, 1]])
    return Camera(viewmats=jnp.eye(4)[None], Ks=K[None], width=GRID_WIDTH, height=HEIGHT)


def test_single_token_gives_its_depth_and_feature_at_its_pixel_and_zero_elsewhere():
    result = jit_project(with_pivots([[0.0, 0.0, 2.0]]), front_camera(), CONFIG)
    assert np.argwhere(np.asarray(result.mask)).tolist() == [[0, 3, 4]]
    assert result.depths[0, 3, 4] == pytest.approx(2.0, rel=VALUE_RTOL)
    assert result.confidences[0, 3, 4] == 0.5
    np.testing.assert_array_equal(result.feats[0, 3, 4], np.ones(WIDTH))
    for x in (result.depths, result.confidences, result.feats, result.colors):
        assert not np.any(np.asarray(x)[~np.asarray(result.mask)])


@pytest.mark.parametrize("z", [-2.0, 0.0, 0.01])
def test_token_behind_the_near_plane_is_invisible(z):
    assert not np.any(jit_project(with_pivots([[0.0, 0.0, z]]), front_camera(), CONFIG).mask)


def test_token_of_confidence_zero_hides_nothing():
    cache = with_pivots([[0.0, 0.0, 1.0], [0.0, 0.0, 3.0]], confidences=[0.0, 0.5])
    assert jit_project(cache, front_camera(), CONFIG).depths[0, 3, 4] == pytest.approx(3.0, rel=VALUE_RTOL)


def test_of_two_surfaces_the_front_one_is_seen():
    result = jit_project(with_pivots([[0.0, 0.0, 4.0], [0.0, 0.0, 2.0], [0.0, 0.0, 2.1]]), front_camera(), CONFIG)
    assert result.depths[0, 3, 4] == pytest.approx(np.sqrt(2.0 * 2.1), rel=VALUE_RTOL)  # the mean of logs
    np.testing.assert_allclose(result.feats[0, 3, 4], 2.5, rtol=VALUE_RTOL)


def test_plain_mean_mixes_the_surfaces():
    result = jit_project(with_pivots([[0.0, 0.0, 4.0], [0.0, 0.0, 1.0]]), front_camera(), LITERAL)
    assert result.depths[0, 3, 4] == pytest.approx(2.0, rel=VALUE_RTOL)


def test_recentring_undoes_the_bias_towards_the_camera():
    """The nearest of many noisy samples of one surface is far in front of it; the cluster's mean must not be."""
    rng = np.random.default_rng(0)
    biases = []
    for _ in range(60):
        depths = 2.0 * np.exp(0.05 * rng.normal(size=CAPACITY))
        means = np.stack([np.zeros(CAPACITY), np.zeros(CAPACITY), depths], axis=-1)
        biases.append(float(jit_project(with_pivots(means), front_camera(), CONFIG).depths[0, 3, 4]) / 2.0 - 1.0)
    assert abs(np.mean(biases)) < 0.005  # ALGORITHM 10.2: -2 % without, under 0.2 % with; 60 x 16 samples give +-0.2 %


def test_permuted_pivots_give_the_same_maps():
    cache, camera = scene(3, CAPACITY, 1.0), cameras(4)
    order = np.random.default_rng(0).permutation(CAPACITY)
    names = ("counts", "means", "confidences", "feats")
    permuted = replace(cache, **{name: getattr(cache, name)[order] for name in names})
    a, b = (jit_project(c, camera, CONFIG) for c in (cache, permuted))
    np.testing.assert_array_equal(a.mask, b.mask)
    for name in ("depths", "confidences", "feats"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=0, atol=4 * VALUE_RTOL)


def test_walking_in_blocks_changes_nothing(monkeypatch):
    """Blocks so small that rows and pairs take many, the last of them partly empty."""
    cache, camera = scene(7, CAPACITY - 3, 0.1), cameras(8)
    whole = jit_project(cache, camera, CONFIG)
    module = importlib.import_module("ssplat_jax.cache.project")  # the package's `project` is the function
    monkeypatch.setattr(module, "ROWS_PER_BLOCK", 4)
    monkeypatch.setattr(module, "PAIRS_PER_BLOCK", 7)
    blocks = jax.jit(lambda *args: project(*args, CONFIG))(cache, camera)
    np.testing.assert_array_equal(whole.mask, blocks.mask)
    for name in ("depths", "confidences", "feats"):
        np.testing.assert_allclose(getattr(whole, name), getattr(blocks, name), rtol=0, atol=4 * VALUE_RTOL)


def test_the_color_of_a_pixel_is_the_mean_over_parts_and_pivots():
    cache = with_pivots([[0.0, 0.0, 2.0], [0.0, 0.0, 2.1]], confidences=[0.75, 0.5])
    parts = np.arange(24.0).reshape(2, 4, 3)  # pivots, parts of a patch, channels
    cache = replace(cache, rgbs=cache.rgbs.at[:2, 0].set(jnp.asarray(parts.reshape(2, 12), jnp.float32)))
    wanted = 0.6 * parts[0].mean(axis=0) + 0.4 * parts[1].mean(axis=0)
    np.testing.assert_allclose(jit_project(cache, front_camera(), CONFIG).colors[0, 3, 4], wanted, rtol=VALUE_RTOL)


def test_unmatched_exposure_leaves_no_trace_in_the_projection():
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


def test_a_coarser_cell_is_the_nearest_of_its_cells_whole():
    fine = jit_project(scene(5, CAPACITY, 0.3), cameras(6), CONFIG)
    assert coarser(fine, 1) is fine
    coarse = coarser(fine, 2)
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
