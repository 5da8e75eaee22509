"""Hard cases of the cache: fuse, project, carve and judge stay finite and reach their limits.

Values only, because no gradient flows through the cache. Tokens that are NaN, out of range or over capacity are in
tests/cache, captures far from their origin in test_world_frame.py.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.cache import VoxelCache, carve, init_cache, judge, project, store_witness
from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.pytree import replace
from tests.cache import streams
from tests.cache.projection_scenes import front_camera, with_pivots
from tests.cache.streams import assert_same_cache, tokens_at
from tests.model.small import finite
from tests.stability.stage_checks import PROBABILITY_SUM_ATOL

pytestmark = pytest.mark.usefixtures("compiled_plainly")

HALF = jnp.bfloat16
CACHE = streams.CONFIG.replace(pivots_per_voxel=2)  # a third token in a voxel merges
ANY = CACHE.replace(min_confidence=0.0)


def empty() -> VoxelCache:
    return init_cache(CACHE, streams.CAPACITY)


def fused(tokens, config=CACHE, cache=None) -> VoxelCache:
    """`cache` after `tokens`, checked to be finite and within its bounds."""
    cache = streams.fuse(empty() if cache is None else jax.tree.map(jnp.copy, cache), tokens, config)
    assert finite(cache)
    alive = np.asarray(cache.alive)
    confidences = np.asarray(cache.confidences)
    assert ((confidences >= 0) & (confidences <= 1)).all() and not confidences[~alive].any()
    return cache


IN_A_VOXEL = [[0.11, 0.10, 0.10], [0.12, 0.10, 0.10], [0.17, 0.10, 0.10]]


def test_omega_0_leaves_the_cache_unchanged():
    before = fused(tokens_at(IN_A_VOXEL))
    after = fused(tokens_at(IN_A_VOXEL, confidences=0.0), cache=before)
    assert_same_cache(before, after)
    assert int(after.stats.num_low_confidence) == 3


def test_masked_views_leave_the_cache_unchanged():
    before = fused(tokens_at(IN_A_VOXEL))
    after = fused(tokens_at(IN_A_VOXEL, valid=False), cache=before)
    jax.tree.map(np.testing.assert_array_equal, before, after)


def test_accepted_omega_0_is_averaged_evenly_and_invisible():
    cache = fused(tokens_at(IN_A_VOXEL, confidences=0.0), ANY)
    np.testing.assert_allclose(cache.means[0, 0], np.mean(IN_A_VOXEL[:2], axis=0), atol=1e-7)
    camera = replace(front_camera(), viewmats=jnp.eye(4).at[2, 3].set(2.0)[None])
    assert not any(np.any(np.asarray(x)) for x in jax.tree.leaves(project(cache, camera, ANY)))


def test_omega_1_beside_omega_0_decides_alone():
    cache = fused(tokens_at(IN_A_VOXEL, confidences=jnp.array([1.0, 0.0, 0.5])), ANY)
    np.testing.assert_array_equal(cache.means[0, 0], np.float32(IN_A_VOXEL[0]))
    assert cache.confidences[0, 0] == 1


@pytest.mark.parametrize("feats", [0.0, 1.0, 1e-30, 1e30], ids=["zero", "identical", "1e-30", "1e30"])
def test_features_without_a_closest_pair_merge_the_first_two(feats):
    """Zero features, and norms whose squares leave float32, count as orthogonal; identical ones are all ties."""
    cache = fused(tokens_at(IN_A_VOXEL, feats=feats))
    assert int(cache.stats.num_merged) == 1
    np.testing.assert_allclose(cache.means[0, 0], np.mean(IN_A_VOXEL[:2], axis=0), atol=1e-7)
    np.testing.assert_array_equal(cache.means[0, 1], np.float32(IN_A_VOXEL[2]))
    np.testing.assert_allclose(cache.feats[0], np.full((2, streams.WIDTH), feats), rtol=1e-6)


def test_equal_confidences_keep_the_older_seed_and_the_midpoint():
    feats = jnp.array([[1.0, 0, 0, 0], [1.0, 0.1, 0, 0], [0, 0, 1.0, 0]])
    cache = fused(replace(tokens_at(IN_A_VOXEL, confidences=0.7), feats=feats))
    np.testing.assert_array_equal(cache.seeds[0, 0], feats[0])
    np.testing.assert_allclose(cache.feats[0, 0], (feats[0] + feats[1]) / 2, atol=1e-7)
    np.testing.assert_allclose(cache.rgbs[0, 0], 0.5, atol=1e-7)
    assert cache.confidences[0, 0] == np.float32(0.7)


def test_hundreds_of_tokens_at_one_point_stay_there():
    tokens = streams.Recipe(seed=1, places="one_voxel", features="normal", confidences="random").tokens()
    tokens["means"][:] = IN_A_VOXEL[0]
    cache = empty()
    for _ in range(8):
        cache = fused(streams.to_jax(tokens), CACHE, cache)
    np.testing.assert_array_equal(cache.means[0], np.tile(np.float32(IN_A_VOXEL[0]), (2, 1)))
    assert int(cache.num_voxels) == 1 and int(cache.stats.num_merged) > 100


def test_a_cache_of_bfloat16_features_is_the_float32_one_rounded():
    """Positions, choices and weights are float32 in both; only features are stored in bfloat16."""
    tokens = streams.to_jax(streams.Recipe(seed=3, places="few", features="normal", confidences="random").tokens())
    tokens = replace(tokens, feats=tokens.feats.astype(HALF).astype(jnp.float32))
    single = fused(tokens)
    blank = empty()
    half = fused(tokens, cache=replace(blank, feats=blank.feats.astype(HALF), seeds=blank.seeds.astype(HALF)))
    assert half.feats.dtype == half.seeds.dtype == HALF and int(single.stats.num_merged) > 0
    for name in ("counts", "voxels", "confidences", "num_members", "footprints"):
        np.testing.assert_array_equal(getattr(half, name), getattr(single, name), name)
    np.testing.assert_allclose(half.means, single.means, atol=1e-7)
    np.testing.assert_allclose(half.feats.astype(jnp.float32), single.feats, atol=0.02)
    camera = replace(front_camera(), viewmats=jnp.eye(4).at[2, 3].set(2.0)[None])
    a, b = (project(cache, camera, CACHE) for cache in (half, single))
    assert a.feats.dtype == jnp.float32 and a.mask.any()
    np.testing.assert_array_equal(a.depths, b.depths)
    np.testing.assert_allclose(a.feats, b.feats, atol=0.02)


# A pivot on the axis of the front camera, and the depth and confidence that are read at its pixel.
SEEN = {
    "omega 1": ([[0, 0, 2.0]], [1.0], (2.0, 1.0)),
    "omega to 0": ([[0, 0, 2.0]], [1e-10], (2.0, 1e-10)),
    "omega whose square underflows": ([[0, 0, 2.0]], [1e-37], (2.0, 0.0)),
    "equal confidences": ([[0, 0, 2.0], [0, 0, 2.1]], [0.5, 0.5], (np.sqrt(2.0 * 2.1), 0.5)),
    "omega 0 before omega 1": ([[0, 0, 1.0], [0, 0, 2.0]], [0.0, 1.0], (2.0, 1.0)),
    "at one point": ([[0, 0, 2.0]] * 16, np.linspace(0.1, 1, 16), None),
    "at the camera": ([[0, 0, 0.0], [0, 0, 2.0]], [1.0, 0.5], (2.0, 0.5)),
    "just before the near plane": ([[0, 0, 0.0101]], [0.5], (0.0101, 0.5)),
    "very far": ([[0, 0, 1e30]], [0.5], (1e30, 0.5)),
    "beside the camera": ([[1e-3, 0, 1e-30], [0, 0, 2.0]], [0.5, 0.5], (2.0, 0.5)),
}


@functools.cache
def reading():
    # Without carving pivots of any confidence are seen, down to those whose square underflows.
    return jax.jit(functools.partial(project, config=CACHE.replace(carving=False)))


@pytest.mark.parametrize("name", SEEN)
def test_hard_projection(name):
    means, confidences, wanted = SEEN[name]
    seen = reading()(with_pivots(means, confidences), front_camera())
    assert finite(seen)
    assert (seen.confidences >= 0).all() and (seen.confidences <= 1 + PROBABILITY_SUM_ATOL).all()
    if wanted is not None:
        assert np.argwhere(np.asarray(seen.mask)).tolist() == [[0, 3, 4]]
        np.testing.assert_allclose((seen.depths[0, 3, 4], seen.confidences[0, 3, 4]), wanted, rtol=1e-4)


def test_carved_pivots_occlude_nothing_in_the_projection():
    cache = with_pivots([[0.0, 0.0, 1.0], [0.0, 0.0, 2.0]], [0.02, 0.9])
    carved = project(cache, front_camera(), CACHE.replace(carving=True))
    kept = project(cache, front_camera(), CACHE.replace(carving=False))
    depths = [float(np.max(np.asarray(seen.depths))) for seen in (carved, kept)]
    np.testing.assert_allclose(depths, [2.0, 1.0], rtol=1e-5)
    np.testing.assert_allclose(np.max(np.asarray(carved.confidences)), 0.9, rtol=1e-5)


def test_equal_cameras_get_equal_projections():
    """Zero baseline; the projection is empty once all cameras look away."""
    rng = np.random.default_rng(2)
    cache = with_pivots(rng.uniform([-0.5, -0.5, 1], [0.5, 0.5, 3], (16, 3)), rng.uniform(0.1, 1, 16))
    both = front_camera()[jnp.zeros(2, jnp.int32)]
    seen = project(cache, both, CACHE)
    assert seen.mask.any()
    jax.tree.map(lambda x: np.testing.assert_array_equal(x[0], x[1]), seen)
    away = replace(both, viewmats=both.viewmats @ jnp.diag(jnp.array([-1.0, 1, -1, 1])))
    assert not project(cache, away, CACHE).mask.any()


CELLS = (1, front_camera().height, front_camera().width)
NOT_JUDGED = None
# name -> (confidence of a pivot at depth 1, depth seen, confidence of the witness, revised confidence)
VERDICTS = {
    "omega 0 is never judged": (0.0, 2.0, 1.0, NOT_JUDGED),
    "omega 1 looked through": (1.0, 2.0, 1.0, 0.72),  # held to 0.95, then odds / e^2
    "omega 1 seen": (1.0, 1.0, 1.0, 0.95),
    "omega to 0 seen": (1e-37, 1.0, 1.0, 0.0326),  # held to 0.02, then odds x e^0.5
    "witness of omega 0": (0.6, 2.0, 0.0, NOT_JUDGED),
    "witness at tau": (0.6, 2.0, float(np.float32(CACHE.memory.min_confidence)), 0.4515),
    "surface on the camera": (0.6, 1e-30, 1.0, NOT_JUDGED),  # the pivot is hidden behind it
    "surface at infinity": (0.6, np.inf, 1.0, NOT_JUDGED),
    "surface at 1e30": (0.6, 1e30, 1.0, 0.1687),
    "all views masked": (0.6, 2.0, 0.0, NOT_JUDGED),
}


@functools.cache
def verdict_programs():
    return (
        jax.jit(functools.partial(carve, config=CACHE)),
        jax.jit(functools.partial(judge, config=CACHE)),
        jax.jit(functools.partial(store_witness, config=CACHE)),
    )


@pytest.mark.parametrize("name", VERDICTS)
def test_hard_verdict_on_pivots_and_tokens(name):
    confidence, depth, weight, wanted = VERDICTS[name]
    carving, judging, storing = verdict_programs()
    seen = (front_camera(), jnp.full(CELLS, depth, jnp.float32), jnp.full(CELLS, weight, jnp.float32))
    pivot = float(carving(with_pivots([[0, 0, 1.0]], [confidence]), *seen).confidences[0, 0])
    wanted = np.float32(confidence) if wanted is NOT_JUDGED else wanted
    assert pivot == pytest.approx(wanted, rel=2e-3) if wanted else pivot == 0
    witness = storing(replace(empty(), stats=replace(empty().stats, num_chunks=jnp.int32(1))), *seen)
    token = judging(witness.witnesses, tokens_at([[0, 0, 1.0]], confidences=confidence))
    assert finite((witness, token))
    below_tau = confidence < CACHE.memory.min_confidence
    assert float(token.confidences[0]) == pytest.approx(confidence if below_tau else wanted, rel=2e-3)


def test_camera_far_from_the_origin_stays_finite():
    """At 6.4e6 float32 has a spacing of 0.5: depths are right to that, and tokens are counted as out of range."""
    far = 6.4e6
    camera = Camera(viewmats=jnp.eye(4).at[2, 3].set(-far)[None], Ks=front_camera().Ks, width=CELLS[2], height=CELLS[1])
    cache = with_pivots([[0, 0, far + 4.0]])
    seen = reading()(cache, camera)
    assert finite(seen) and seen.depths[0, 3, 4] == pytest.approx(4.0, abs=0.5)
    after = fused(tokens_at([[0, 0, far + 4.0]]))
    assert int(after.stats.num_out_of_range) == 1 and int(after.num_voxels) == 0
