"""Speed of the cache, by itself: what a chunk costs, and that the cost depends on the chunk alone.

The chunk of the fuse is the dearest kind: it looks again at a patch of voxels that are all full, so that every token
merges. Timings that are compared are taken in turns in one process, and the ratio is that of the medians, because a
machine that others use drifts by more than the differences of interest.
"""

import dataclasses
import functools
import math
import statistics
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from ssplat_jax.cache import reference
from ssplat_jax.cache.fuse import fuse
from ssplat_jax.cache.project import project
from ssplat_jax.cache.state import Tokens, VoxelCache, init_cache
from ssplat_jax.config import StreamConfig
from ssplat_jax.geometry.cameras import Camera

PATCH = 2048
"""Voxels that the chunk of the fuse falls into."""


@dataclasses.dataclass(frozen=True)
class Row:
    """One figure."""

    name: str
    value: float
    unit: str
    wanted: str = ""


def bench_cache(config: StreamConfig, *, num_tokens: int = 16384, repeats: int = 9) -> list[Row]:
    """All figures of the cache: fuse against occupancy, capacity and the NumPy loop, projection, stream length."""
    config = config.replace(overflow="drop_new", vacc="voxel")
    return [
        *bench_occupancy(config, num_tokens=num_tokens, repeats=repeats),
        *bench_capacity(config, num_tokens=num_tokens, repeats=repeats),
        *bench_oracle(config, num_tokens=num_tokens, repeats=repeats),
        *bench_projection(config, repeats=repeats),
        *bench_stream(config),
    ]


def bench_occupancy(config: StreamConfig, *, num_tokens: int, repeats: int, capacity: int = 1 << 18) -> list[Row]:
    """The same chunk in a cache that is 1 % and 90 % full."""
    chunk = patch_tokens(config, num_tokens, seed=0)
    step = _compiled_fuse(config.replace(capacity=capacity), chunk)
    caches = [_filled_cache(config, capacity, chunk, step, share) for share in (0.01, 0.9)]
    low, high = _take_turns([functools.partial(step, tokens=chunk)] * 2, caches, repeats)
    return [
        Row("fuse_at_1_percent", low * 1e3, "ms"),
        Row("fuse_at_90_percent", high * 1e3, "ms"),
        Row("fuse_occupancy_ratio", high / low, "x", "<= 1.2"),
    ]


def bench_capacity(config: StreamConfig, *, num_tokens: int, repeats: int) -> list[Row]:
    """The same chunk in a small and in a large cache, and whether the large one is updated in place."""
    chunk = patch_tokens(config, num_tokens, seed=0)
    capacities = (1 << 14, 1 << 18)
    steps = [_compiled_fuse(config.replace(capacity=capacity), chunk) for capacity in capacities]
    caches = [step(init_cache(config, capacity), chunk) for step, capacity in zip(steps, capacities, strict=True)]
    small, large = _take_turns([functools.partial(step, tokens=chunk) for step in steps], caches, repeats)
    memory = steps[1].memory_analysis()
    rows = [
        Row("fuse_at_2^14", small * 1e3, "ms"),
        Row("fuse_at_2^18", large * 1e3, "ms"),
        Row("fuse_capacity_ratio", large / small, "x", "<= 1.25"),
    ]
    if memory is not None:
        not_in_place = _num_bytes(init_cache(config, capacities[1])) - memory.alias_size_in_bytes
        rows.append(Row("fuse_bytes_copied_of_cache", not_in_place, "bytes", "0"))
        rows.append(Row("fuse_work_memory", memory.temp_size_in_bytes, "bytes"))
    return rows


def bench_oracle(config: StreamConfig, *, num_tokens: int, repeats: int) -> list[Row]:
    """Tokens per second, and how many times the NumPy loop that is."""
    chunk = patch_tokens(config, num_tokens, seed=0)
    step = _compiled_fuse(config, chunk)
    (fast,) = _take_turns([functools.partial(step, tokens=chunk)], [step(init_cache(config), chunk)], repeats)
    arrays = {field.name: np.asarray(getattr(chunk, field.name)) for field in dataclasses.fields(Tokens)}
    oracle = reference.fuse(reference.empty(config.capacity), arrays, config)
    start = time.perf_counter()
    reference.fuse(oracle, arrays, config)
    slow = time.perf_counter() - start
    return [
        Row("fuse_tokens_per_second", num_tokens / fast, "1/s", ">= 400000"),
        Row("fuse_speedup_over_numpy_loop", slow / fast, "x", ">= 200"),
    ]


def bench_projection(config: StreamConfig, *, repeats: int, num_rows: int = 25_000) -> list[Row]:
    """Four views of 60 x 80 cells, with the same live pivots in caches of two capacities."""
    camera = _cameras()
    step = jax.jit(lambda cache: project(cache, camera, config))
    caches = [_room(config, capacity, num_rows) for capacity in (1 << 15, 1 << 18)]
    keep = lambda cache: (step(cache), cache)[1:]  # noqa: E731 - timed for its work, carries the cache on
    calls = [lambda cache: _wait(step(cache), cache)] * 2
    del keep
    small, large = _take_turns(calls, caches, repeats)
    return [
        Row("project_100k_pivots", small * 1e3, "ms"),
        Row("project_capacity_ratio", large / small, "x", "<= 1.25"),
    ]
