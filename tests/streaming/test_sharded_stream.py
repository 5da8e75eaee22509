"""Checks of `ShardedStream` that one device suffices for: refused meshes, dropped tokens and spare capacity."""

import jax
import numpy as np
import pytest

from ssplat_jax.core.errors import CacheError, InputError
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.streaming.sharded import ShardedStream, _from_first_shard
from tests.streaming.narrow_model import NARROW


def mesh_of_one(axes=("streams", "voxels")) -> jax.sharding.Mesh:
    return jax.sharding.Mesh(np.array(jax.devices()[:1]).reshape(1, 1), axes)


def test_mesh_without_the_axes_is_refused():
    with pytest.raises(InputError, match=r"'streams' and 'voxels', got \('data', 'voxels'\)"):
        ShardedStream(StreamSplat(NARROW), mesh_of_one(("data", "voxels")))
    with pytest.raises(InputError, match="another for voxels"):
        ShardedStream(StreamSplat(NARROW), mesh_of_one(), streams="voxels")
    assert ShardedStream(StreamSplat(NARROW), mesh_of_one(("data", "voxels")), streams="data").streams == "data"


def test_streams_that_do_not_divide_over_the_rows_are_refused():
    two_rows = jax.sharding.Mesh(np.array(jax.devices()[:1] * 2).reshape(2, 1), ("streams", "voxels"))
    with pytest.raises(InputError, match="multiple of the mesh's 2, got 3"):
        ShardedStream(StreamSplat(NARROW), two_rows).init_cache(3)


def test_dropped_tokens_raise_if_the_cache_should_grow():
    sharded = ShardedStream(StreamSplat(NARROW.replace(overflow="grow", capacity=128)), mesh_of_one())
    caches = sharded.init_cache(2)
    sharded.check(caches)
    is_dropped = lambda path: path[-1].name == "num_dropped"  # noqa: E731
    dropped = jax.tree_util.tree_map_with_path(lambda path, x: x.at[1].set(3) if is_dropped(path) else x, caches)
    with pytest.raises(CacheError, match=r"3 did not fit in 128 voxels.*ensure_capacity"):
        sharded.check(dropped)


def test_caches_that_need_not_or_may_not_grow_stay_unchanged():
    for overflow, num_new_tokens in (("grow", 128), ("drop_new", 1000)):
        sharded = ShardedStream(StreamSplat(NARROW.replace(overflow=overflow, capacity=128)), mesh_of_one())
        caches = sharded.init_cache()
        assert sharded.ensure_capacity(caches, num_new_tokens) is caches


def test_all_shards_get_the_floats_of_the_first():
    values = np.array([[1.5, -0.0, 0.0, np.nan, np.inf], [1.5000001, 7.0, -0.0, 1.0, -np.inf]], np.float32)
    flags = np.array([True, False])
    found, kept = jax.vmap(lambda x: _from_first_shard(x, "voxels"), axis_name="voxels")((values, flags))
    np.testing.assert_array_equal(found, values[[0, 0]])
    np.testing.assert_array_equal(kept, flags)
