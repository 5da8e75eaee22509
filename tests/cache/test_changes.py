"""Laws of changes: Gaussians differ only where theirs is not 0, and moved pivots stay in their voxels."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.cache.changes import BOUNDS, WIDTH, Change, changed_gaussians, settle, unpack
from ssplat_jax.cache.hash_table import voxel_indices
from ssplat_jax.cache.state import init_cache
from ssplat_jax.core.gaussians import SH_C0, Gaussians
from ssplat_jax.core.pytree import replace
from tests.cache.streams import CAPACITY, CONFIG, Recipe, fuse, revised, to_jax
from tests.rasterizer.scenes import cloud

SIZE = CONFIG.memory.voxel_size
PER_TOKEN = CONFIG.head.gaussians_per_token
REFINED = CONFIG.replace(steps_per_chunk=1)
FOOTPRINT = 1.5 * SIZE
_SETTLE, _VOXELS = jax.jit(settle, static_argnums=3), jax.jit(voxel_indices, static_argnums=2)


def settled(means, change):
    return _SETTLE(means, jnp.full(len(means), FOOTPRINT), change, CONFIG)


def pivots(seed: int, span: float, count: int = 256) -> jax.Array:
    """Places of pivots up to `span` voxels from the origin, some of them on faces of voxels."""
    means = np.random.default_rng(seed).uniform(-span, span, (count, 3)) * SIZE
    means[::5] = np.round(means[::5] / SIZE) * SIZE
    return jnp.asarray(means, jnp.float32)


def changes(seed: int, scale: float, count: int = 256) -> Change:
    packed = np.random.default_rng(seed).normal(size=(count, PER_TOKEN * WIDTH)) * scale
    return unpack(jnp.asarray(packed, jnp.float32))


def cells(means) -> np.ndarray:
    return np.asarray(_VOXELS(means, np.full(means.shape[:-1], FOOTPRINT, np.float32), CONFIG)[0])


@pytest.mark.parametrize("span", [2.0, 300.0, 1e6])
@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_moved_pivots_stay_in_their_voxels(span, scale):
    means = pivots(1, span)
    moved, packed = settled(means, changes(2, scale))
    np.testing.assert_array_equal(cells(moved), cells(means))
    if span <= 300:  # farther out a float32 is coarser than the margin
        places = moved[:, None] + unpack(packed).means.reshape(-1, PER_TOKEN, 3)
        np.testing.assert_array_equal(cells(places), np.broadcast_to(cells(means)[:, None], cells(places).shape))
        assert scale < 0.1 or float(jnp.abs(moved - means).max()) > 0.01 * SIZE


def test_what_settles_is_bounded_and_has_no_common_move():
    change = unpack(settled(pivots(1, 4.0), changes(2, 100.0))[1])
    for name, bound in BOUNDS.items():
        assert float(jnp.abs(getattr(change, name)).max()) == pytest.approx(bound), name
    assert float(jnp.abs(change.means.reshape(-1, PER_TOKEN, 3).mean(axis=1)).max()) < 1e-6 * SIZE


def test_changes_that_are_not_finite_become_zero():
    bad = jnp.array([np.nan, np.inf, -np.inf])
    change = jax.tree.map(lambda x: x.at[:3].set(bad.reshape(3, *[1] * (x.ndim - 1))), changes(4, 0.01))
    moved, packed = settled(pivots(5, 4.0), change)
    assert np.isfinite(moved).all() and np.isfinite(packed).all()
    assert not np.any(packed[0].reshape(-1, WIDTH)[:3, 3:])


def test_merges_of_changed_pivots_stay_in_their_voxels():
    """Several tokens fall into each of few voxels, and all pivots are moved as far as they may after every chunk."""
    cache, rng = init_cache(REFINED, CAPACITY), np.random.default_rng(0)
    for seed in range(6):
        places = ("few", "one_voxel", "boundaries")[seed % 3]
        cache = fuse(cache, to_jax(Recipe(seed, places, "normal", "random").tokens()), REFINED)
        alive = np.asarray(cache.alive)
        shifts = np.asarray(unpack(cache.changes.reshape(-1, PER_TOKEN * WIDTH)).means)
        means, voxels = np.asarray(cache.means), np.asarray(cache.voxels)[:, None]
        places = means[:, :, None] + shifts.reshape(*alive.shape, PER_TOKEN, 3)
        for points, wanted in ((means, voxels), (places, voxels[:, :, None])):
            footprints = np.reshape(cache.footprints, (*alive.shape, *[1] * (points.ndim - 3)))
            found, _ = _VOXELS(points, np.broadcast_to(footprints, points.shape[:-1]), REFINED)
            wanted = np.broadcast_to(wanted, found.shape)
            np.testing.assert_array_equal(np.asarray(found)[alive], wanted[alive], f"chunk {seed}")
        cache = revised(cache, rng, REFINED)
    assert int(cache.stats.num_merged) > 20


def gaussians(count: int) -> Gaussians:
    """Every fourth is absent."""
    scene = cloud(count, seed=8)
    return replace(scene, opacities=scene.opacities.at[::4].set(0.0))


def test_gaussians_without_a_change_keep_their_bits():
    scene = gaussians(256 * PER_TOKEN)
    half = jax.tree.map(lambda x: x.at[::2].set(0.0), changes(9, 0.1))
    new_scene = jax.jit(lambda: changed_gaussians(scene, half, max_scale=1.0))()
    jax.tree.map(lambda new, old: np.testing.assert_array_equal(new[::2], old[::2]), new_scene, scene)
    assert not np.any(np.asarray(new_scene.opacities)[np.asarray(scene.opacities) == 0])


def test_each_part_of_a_change_changes_what_it_names():
    count = 64
    scene, zero = gaussians(count), jax.tree.map(jnp.zeros_like, changes(0, 0.0, count // PER_TOKEN))
    is_present = np.asarray(scene.opacities) > 0
    parts = {
        "means": jnp.full((count, 3), 0.5),
        "log_scales": jnp.full((count, 3), np.log(2.0)),
        "sh": jnp.full((count, 1, 3), 0.25 / SH_C0),
        "logit_opacities": jnp.full(count, -1.0),
    }
    change = jax.jit(lambda x: changed_gaussians(scene, x, max_scale=0.12))
    new = {name: change(replace(zero, **{name: x})) for name, x in parts.items()}
    old = jax.tree.map(lambda x: np.asarray(x)[is_present], scene)
    new = {name: jax.tree.map(lambda x: np.asarray(x)[is_present], g) for name, g in new.items()}
    np.testing.assert_allclose(new["means"].means, old.means + 0.5)
    # Scales that were above the limit before are not shrunk.
    np.testing.assert_allclose(
        new["log_scales"].scales, np.maximum(old.scales, np.minimum(2 * old.scales, 0.12)), rtol=1e-6
    )
    np.testing.assert_allclose(SH_C0 * (new["sh"].sh - old.sh)[:, 0], 0.25, rtol=1e-5)
    logits = lambda o: np.log(o) - np.log1p(-o)  # noqa: E731
    np.testing.assert_allclose(logits(new["logit_opacities"].opacities), logits(old.opacities) - 1, atol=1e-3)


@pytest.mark.parametrize("per_token", [1, 4, 16])
def test_a_change_of_zero_moves_no_pivot_by_a_bit(per_token):
    """Also where the sum of equal numbers is rounded."""
    means = pivots(3, 300.0, 4096)
    moved, packed = settled(means, unpack(jnp.zeros((4096, per_token * WIDTH))))
    np.testing.assert_array_equal(moved, means)
    assert not np.asarray(packed).any()
