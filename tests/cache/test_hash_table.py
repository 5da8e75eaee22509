"""Voxel indices equal those of float32 NumPy, and the hash table finds every voxel and confuses no two."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ssplat_jax.cache.fuse import _stable_order
from ssplat_jax.cache.hash_table import (
    INDEX_LIMIT,
    MAX_LEVEL,
    build_table,
    find_rows,
    group_equal,
    hash_voxels,
    insert_rows,
    voxel_indices,
    voxel_levels,
    voxel_sides,
)
from ssplat_jax.config import PAPER, StreamConfig

CONFIG = StreamConfig()
RNG = np.random.default_rng(0)


@pytest.mark.parametrize("voxel_size", [0.04, 0.25, 0.1, 1 / 3])
def test_voxel_is_the_floor_of_one_float32_product(voxel_size):
    points = np.concatenate([RNG.uniform(-5, 5, (500, 3)), RNG.integers(-9, 9, (500, 3)) * voxel_size])
    points = points.astype(np.float32)
    config = StreamConfig().replace(voxel_size=voxel_size)
    voxels, in_range = voxel_indices(jnp.asarray(points), jnp.full(1000, 1.5 * voxel_size), config)
    np.testing.assert_array_equal(voxels[:, :3], np.floor(points * np.float32(1 / voxel_size)).astype(int))
    assert np.all(np.asarray(in_range)) and not np.any(voxels[:, 3])


@settings(max_examples=50, deadline=None, derandomize=True)
@given(
    st.lists(st.integers(-(10**6), 10**6).map(lambda i: i / 33333), min_size=3, max_size=3),
    st.floats(2.0**-9, 64, width=32),
)
def test_levels_partition_space_and_nest(point, footprint):
    """A token has one voxel: it holds the point, is between half as wide and as wide as the token, and the voxel of a
    token twice as wide is made of eight such ones."""
    point, footprint = jnp.array(point), jnp.float32(footprint)
    (*cell, level), (*larger, next_level) = (
        np.asarray(voxel_indices(point, f, CONFIG)[0]) for f in (footprint, 2 * footprint)
    )
    side, per_unit = float(voxel_sides(footprint, CONFIG)), np.float32(1 / CONFIG.memory.voxel_size)
    assert side == np.float32(CONFIG.memory.voxel_size) * 2.0**level
    assert side < footprint * (1 + 1e-6) and footprint < 2 * side * (1 + 1e-6)
    inside = np.asarray(point) * per_unit / np.float32(2.0**level) - np.array(cell)
    assert np.all((inside >= 0) & (inside < 1))
    assert next_level == level + 1 and np.array_equal(larger, np.floor_divide(cell, 2))


def test_points_on_faces_of_large_voxels_lie_on_faces_of_small_ones():
    """At every level, where a rounded power of two would put them on either side."""
    levels = np.repeat(np.arange(-MAX_LEVEL, MAX_LEVEL + 1), 101)
    faces = np.tile(np.arange(-50, 51), 2 * MAX_LEVEL + 1)
    config = StreamConfig().replace(voxel_size=0.25)
    points = jnp.asarray(np.repeat(faces[:, None] * 0.25 * 2.0 ** levels[:, None], 3, axis=1), jnp.float32)
    footprints = jnp.asarray(0.3 * 2.0**levels, jnp.float32)
    voxels, _ = jax.jit(voxel_indices, static_argnums=2)(points, footprints, config)
    np.testing.assert_array_equal(voxels, np.stack([faces, faces, faces, levels], axis=1))


def test_without_detail_all_voxels_have_one_size():
    footprints = jnp.array([1e-9, 0.02, 0.5, 1e9, 0.0, jnp.nan, jnp.inf])
    for config, wanted in ((PAPER, [0] * 7), (CONFIG, [-MAX_LEVEL, -1, 4, MAX_LEVEL])):
        levels = np.asarray(voxel_levels(footprints, config))
        np.testing.assert_array_equal(levels[: len(wanted)], wanted)
        assert np.all(np.abs(levels) <= MAX_LEVEL)


def test_indices_out_of_range_are_zero():
    cells = jnp.array([INDEX_LIMIT, -INDEX_LIMIT, 1e30, jnp.inf, -jnp.inf, jnp.nan, INDEX_LIMIT - 0.5, 1 - INDEX_LIMIT])
    points = jnp.stack([jnp.zeros(8), cells * 0.25, jnp.ones(8)], axis=-1)
    voxels, in_range = voxel_indices(points, jnp.full(8, 0.3), StreamConfig().replace(voxel_size=0.25))
    assert np.asarray(in_range).tolist() == [False] * 6 + [True] * 2 and not np.any(np.asarray(voxels)[:6, :3])
    np.testing.assert_array_equal(voxels[6:, 1], [INDEX_LIMIT - 1, 1 - INDEX_LIMIT])


def test_hash_spreads_a_plane_of_voxels_like_random_keys():
    """Surfaces are planes of voxels: 2^14 voxels in 2^16 slots collide as often as random keys do."""
    side = 128
    for fixed in range(3):
        plane = np.insert(np.stack(np.divmod(np.arange(side**2), side), axis=-1) - 64, fixed, 7, axis=1)
        plane = np.pad(plane, ((0, 0), (0, 1)), constant_values=-2)
        slots = np.asarray(hash_voxels(jnp.asarray(plane))) % (4 * side**2)
        expected = 4 * side**2 * (1 - np.exp(-1 / 4))  # distinct slots hit by random keys
        assert abs(len(np.unique(slots)) - expected) < 4 * np.sqrt(side**2)


def colliding(num: int) -> np.ndarray:
    """Distinct voxels that all hash to the same slot of 64."""
    voxels = RNG.integers(-500, 500, (200 * num, 4))
    voxels[:, 3] = RNG.integers(-3, 4, 200 * num)
    voxels = voxels[np.asarray(hash_voxels(jnp.asarray(voxels))) % 64 == 5]
    return np.unique(voxels, axis=0)[:num].astype(np.int32)


def test_voxels_of_equal_hash_are_distinguished():
    voxels = colliding(12)
    assert len(voxels) == 12
    table = build_table(jnp.asarray(np.pad(voxels, ((0, 4), (0, 0)))), jnp.int32(8))
    stored = jnp.asarray(np.pad(voxels, ((0, 4), (0, 0))))
    rows = find_rows(table, stored, jnp.asarray(voxels), jnp.ones(12, bool))
    np.testing.assert_array_equal(rows, [*range(8), *[-1] * 4])
    table = insert_rows(table, jnp.asarray(voxels), jnp.arange(12), jnp.arange(12) >= 8)
    np.testing.assert_array_equal(find_rows(table, stored, jnp.asarray(voxels), jnp.ones(12, bool)), np.arange(12))


def test_equal_voxels_are_grouped_under_the_first():
    voxels = np.concatenate([colliding(8), RNG.integers(0, 3, (56, 4))]).astype(np.int32)
    voxels = voxels[RNG.integers(0, 64, 400)]
    active = RNG.uniform(size=400) < 0.8
    leaders = jax.jit(group_equal)(jnp.asarray(voxels), jnp.asarray(active))
    first: dict = {}
    expected = [first.setdefault(tuple(v), i) if a else i for i, (v, a) in enumerate(zip(voxels, active, strict=True))]
    np.testing.assert_array_equal(leaders, expected)


@pytest.mark.parametrize("num_tokens", [1, 1000, 65535, 65600])
def test_stable_order_holds_for_any_number_of_tokens(num_tokens):
    """From 65536 tokens on, key and index no longer fit in one 32-bit word."""
    keys = np.minimum(RNG.integers(0, num_tokens + 1, num_tokens) // 7 * 7, num_tokens).astype(np.int32)
    np.testing.assert_array_equal(_stable_order(jnp.asarray(keys)), np.argsort(keys, kind="stable"))
