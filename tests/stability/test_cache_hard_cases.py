"""Hard cases of the cache: fuse and project stay finite and reach their limits.

Values only, because no gradient flows through the cache. Tokens that are NaN, out of range or over capacity are in
tests/cache/test_fuse.py, hard votes in test_votes.py, captures far from their origin in test_world_frame.py.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.cache.project import project
from ssplat_jax.cache.state import VoxelCache, init_cache
from ssplat_jax.core.pytree import replace
from tests.cache import streams
from tests.cache.projection_scenes import front_camera, with_pivots
from tests.cache.streams import tokens_at
from tests.model.small import finite

pytestmark = pytest.mark.usefixtures("compiled_plainly")

CACHE = streams.PAIRS  # a third token in a voxel merges
ANY = CACHE.replace(min_confidence=0.0)
# Without carving pivots of any confidence are seen, down to those whose square underflows.
READ = jax.jit(functools.partial(project, config=CACHE.replace(carving=False)))
IN_A_VOXEL = [[0.11, 0.10, 0.10], [0.12, 0.10, 0.10], [0.17, 0.10, 0.10]]


def fused(tokens, config=CACHE) -> VoxelCache:
    """A cache after `tokens`, checked to be finite and within its bounds."""
    cache = streams.fuse(init_cache(config, streams.CAPACITY), tokens, config)
    assert finite(cache)
    alive, confidences = np.asarray(cache.alive), np.asarray(cache.confidences)
    assert ((confidences >= 0) & (confidences <= 1)).all() and not confidences[~alive].any()
    return cache


def test_accepted_omega_0_is_averaged_evenly_and_invisible_and_omega_1_decides_alone():
    cache = fused(tokens_at(IN_A_VOXEL, confidences=0.0), ANY)
    np.testing.assert_allclose(cache.means[0, 0], np.mean(IN_A_VOXEL[:2], axis=0), atol=1e-7)
    camera = replace(front_camera(), viewmats=jnp.eye(4).at[2, 3].set(2.0)[None])
    assert not any(np.any(np.asarray(x)) for x in jax.tree.leaves(READ(cache, camera)))
    cache = fused(tokens_at(IN_A_VOXEL, confidences=jnp.array([1.0, 0.0, 0.5])), ANY)
    np.testing.assert_array_equal(cache.means[0, 0], np.float32(IN_A_VOXEL[0]))
    assert cache.confidences[0, 0] == 1


# Pivots on the axis of the front camera, and the depth and confidence that are read at their pixel.
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


@pytest.mark.parametrize("name", SEEN)
def test_hard_projection(name):
    means, confidences, wanted = SEEN[name]
    seen = READ(with_pivots(means, confidences), front_camera())
    assert finite(seen)
    assert (seen.confidences >= 0).all() and (seen.confidences <= 1 + 1e-6).all()
    if wanted is not None:
        assert np.argwhere(np.asarray(seen.mask)).tolist() == [[0, 3, 4]]
        np.testing.assert_allclose((seen.depths[0, 3, 4], seen.confidences[0, 3, 4]), wanted, rtol=1e-4)


def test_a_camera_far_from_the_origin_stays_finite():
    """At 6.4e6 float32 has a spacing of 0.5: depths are right to that, and tokens are counted as out of range."""
    far = 6.4e6
    camera = replace(front_camera(), viewmats=jnp.eye(4).at[2, 3].set(-far)[None])
    seen = READ(with_pivots([[0, 0, far + 4.0]]), camera)
    assert finite(seen) and seen.depths[0, 3, 4] == pytest.approx(4.0, abs=0.5)
    after = fused(tokens_at([[0, 0, far + 4.0]]))
    assert int(after.stats.num_out_of_range) == 1 and int(after.num_voxels) == 0
