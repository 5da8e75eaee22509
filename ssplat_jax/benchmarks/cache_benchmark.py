"""Speed of the cache: the cost of a chunk, and whether it depends on anything but the chunk.

The chunk that is fused is the most expensive kind: its voxels are all full, so that every token merges. Timings to be
compared are taken alternately in one process, and the minimum counts: other load on the machine only adds time.
"""

import dataclasses
import functools
import statistics
import time
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from ssplat_jax.cache import numpy_reference as reference
from ssplat_jax.cache.fuse import fuse
from ssplat_jax.cache.hash_table import insert_rows
from ssplat_jax.cache.project import project
from ssplat_jax.cache.state import Tokens, VoxelCache, init_cache
from ssplat_jax.config import StreamConfig
from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.pytree import replace

NUM_PATCH_VOXELS = 2048
"""Voxels into which the tokens of the fused chunk fall."""


@dataclasses.dataclass(frozen=True)
class Row:
    """One figure, with the value that is wanted."""

    name: str
    value: float
    unit: str
    wanted: str = ""


def bench_cache(config: StreamConfig, *, num_tokens: int = 16384, repeats: int = 25) -> list[Row]:
    """All figures of the cache: fuse by occupancy, by capacity and against NumPy, projection, stream length."""
    config = config.replace(overflow="drop_new", vacc="voxel")
    return [
        *bench_occupancy(config, num_tokens=num_tokens, repeats=repeats),
        *bench_capacity(config, num_tokens=num_tokens, repeats=repeats),
        *bench_oracle(config, num_tokens=num_tokens, repeats=repeats),
        *bench_projection(config, repeats=repeats),
        *bench_stream(config),
    ]


def bench_occupancy(config: StreamConfig, *, num_tokens: int, repeats: int, capacity: int = 1 << 18) -> list[Row]:
    """Fusing one chunk into a cache that is 1 % full and one that is 90 % full."""
    chunk = patch_tokens(config, num_tokens)
    step = compile_fuse(config, capacity, chunk)
    caches = [_occupied(config, step(init_cache(config, capacity), chunk), share) for share in (0.01, 0.9)]
    low, high = time_alternately([_Stream(step, cache, chunk) for cache in caches], repeats)
    return [
        Row("fuse_at_1_percent", low * 1e3, "ms"),
        Row("fuse_at_90_percent", high * 1e3, "ms"),
        Row("fuse_occupancy_ratio", high / low, "x", "<= 1.2"),
    ]


def bench_capacity(config: StreamConfig, *, num_tokens: int, repeats: int) -> list[Row]:
    """Fusing one chunk into a small and a large cache, and the bytes of the large one that are copied."""
    chunk = patch_tokens(config, num_tokens)
    capacities = (1 << 14, 1 << 18)
    steps = [compile_fuse(config, capacity, chunk) for capacity in capacities]
    caches = [init_cache(config, capacity) for capacity in capacities]
    small, large = time_alternately([_Stream(*pair, chunk) for pair in zip(steps, caches, strict=True)], repeats)
    rows = [
        Row("fuse_at_2^14", small * 1e3, "ms"),
        Row("fuse_at_2^18", large * 1e3, "ms"),
        Row("fuse_capacity_ratio", large / small, "x", "<= 1.25"),
    ]
    memory = steps[1].memory_analysis()
    if memory is not None:  # None on some backends
        copied = num_bytes(init_cache(config, capacities[1])) - memory.alias_size_in_bytes
        rows.append(Row("fuse_cache_bytes_copied", copied, "B", "0"))
        rows.append(Row("fuse_work_memory", memory.temp_size_in_bytes, "B"))
    return rows


def bench_oracle(config: StreamConfig, *, num_tokens: int, repeats: int) -> list[Row]:
    """Tokens fused per second, and the ratio to the NumPy loop."""
    chunk = patch_tokens(config, num_tokens)
    stream = _Stream(compile_fuse(config, config.memory.capacity, chunk), init_cache(config), chunk)
    arrays = {field.name: np.asarray(getattr(chunk, field.name)) for field in dataclasses.fields(Tokens)}
    oracle = reference.fuse(reference.empty(config.memory.capacity), arrays, config)
    # Eight calls in a row: in a stream, the last chunk fused is still in the processor's caches.
    *fast, slow = time_alternately([*[stream] * 8, lambda: reference.fuse(oracle, arrays, config)], min(repeats, 3))
    return [
        Row("fuse_tokens_per_second", num_tokens / min(fast), "1/s", ">= 400000"),
        Row("fuse_speedup_over_numpy_loop", slow / min(fast), "x", ">= 200"),
    ]


def bench_projection(config: StreamConfig, *, repeats: int, num_rows: int = 25_000) -> list[Row]:
    """Projecting 100,000 pivots into four views of 60 x 80 cells: from a small cache, a large one, and a larger scene.

    Seven of eight pivots of the larger scene are behind the cameras.
    """
    camera = _cameras()
    step = jax.jit(lambda cache: project(cache, camera, config))
    large = 1 << 18
    caches = [
        _filled(config, 1 << 15, num_rows),
        _filled(config, large, num_rows),
        _filled(config, large, 8 * num_rows, num_in_sight=num_rows),
    ]
    seconds = time_alternately([functools.partial(step, cache) for cache in caches], repeats)
    return [
        Row("project_100k_pivots", seconds[0] * 1e3, "ms", "<= 150"),
        Row("project_capacity_ratio", seconds[1] / seconds[0], "x", "<= 1.25"),
        Row("project_scene_ratio", seconds[2] / seconds[1], "x", "<= 1.5"),
    ]


def bench_stream(config: StreamConfig, *, num_tokens: int = 1024, num_chunks: int = 2500) -> list[Row]:
    """Fuse and projection of one repeated chunk, after `num_chunks` chunks against after ten.

    The addresses of its arrays change a stream's speed by a tenth, so both ages are timed from many fresh copies, and
    the medians count.
    """
    camera, chunk, traces = _cameras(), patch_tokens(config, num_tokens), []

    def step(cache, tokens):
        traces.append(1)
        seen = project(cache, camera, config)
        # Tokens depend on the projection, as in the model, so that it is not optimized away.
        return fuse(cache, replace(tokens, valid=tokens.valid & jnp.isfinite(seen.feats).all()), config)

    program = jax.jit(step, donate_argnums=0)
    stream, ages = _Stream(program, init_cache(config), chunk), []
    for age in (10, num_chunks):
        while int(stream.cache.stats.num_chunks) < age:
            stream()
        ages.append(jax.tree.map(jnp.copy, stream.cache))
    early, late = _medians_over_copies(program, ages, chunk)
    return [
        Row("stream_late_chunk_over_early", late / early, "x", "<= 1.05"),
        Row("stream_compilations", len(traces), "", "1"),
    ]


def patch_tokens(config: StreamConfig, num_tokens: int, num_voxels: int = NUM_PATCH_VOXELS) -> Tokens:
    """Random tokens in a rectangular patch of voxels, all confident enough to enter."""
    rng = np.random.default_rng(0)
    cells = rng.integers(0, num_voxels, num_tokens)
    corners = np.stack([cells % 64, cells // 64, np.zeros_like(cells)], axis=-1)
    values = {
        "means": (corners + rng.uniform(0.05, 0.95, (num_tokens, 3))) * config.memory.voxel_size,
        "feats": rng.normal(size=(num_tokens, config.network.token_width)),
        "confidences": rng.uniform(config.memory.min_confidence, 1.0, num_tokens),
        "rgbs": rng.uniform(size=(num_tokens, 3 * config.head.gaussians_per_token)),
        "quats": rng.normal(size=(num_tokens, 4)),
        "footprints": rng.uniform(0.01, 0.05, num_tokens),
    }
    arrays = {name: jnp.asarray(x, jnp.float32) for name, x in values.items()}
    return Tokens(**arrays, valid=jnp.ones((num_tokens,), bool))


def compile_fuse(config: StreamConfig, capacity: int, chunk: Tokens) -> jax.stages.Compiled:
    """The compiled fuse of `chunk`, cache donated."""
    cache = jax.eval_shape(lambda: init_cache(config, capacity))
    return jax.jit(lambda cache, tokens: fuse(cache, tokens, config), donate_argnums=0).lower(cache, chunk).compile()


def time_alternately(calls: Sequence[Callable[[], object]], repeats: int) -> list[float]:
    """Minimum seconds of each call, timed alternately after two rounds of warm-up."""
    seconds = [[_seconds(call) for call in calls] for _ in range(repeats + 2)][2:]
    return [min(column) for column in zip(*seconds, strict=True)]


def num_bytes(tree: object) -> int:
    """Bytes of all arrays of a pytree."""
    return sum(x.nbytes for x in jax.tree.leaves(tree))


def _medians_over_copies(program, caches: list[VoxelCache], chunk: Tokens, *, repeats: int = 30) -> list[float]:
    """Median seconds of a step from each of `caches`, over copies; for each copy, the minimum of three."""
    seconds = []
    for _ in range(repeats):
        streams = [_Stream(program, jax.tree.map(jnp.copy, cache), chunk) for cache in caches]
        seconds.append(time_alternately(streams, repeats=3))
    return [statistics.median(column) for column in zip(*seconds, strict=True)]


class _Stream:
    """Feeds one chunk repeatedly to a cache that is donated each time."""

    def __init__(self, step: Callable[[VoxelCache, Tokens], VoxelCache], cache: VoxelCache, chunk: Tokens) -> None:
        self._step, self.cache, self._chunk = step, cache, chunk

    def __call__(self) -> VoxelCache:
        self.cache = jax.block_until_ready(self._step(self.cache, self._chunk))
        return self.cache


def _seconds(call: Callable[[], object]) -> float:
    start = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - start


def _occupied(config: StreamConfig, cache: VoxelCache, share: float) -> VoxelCache:
    """`cache` with voxels far from the patch added until `share` of it is occupied."""
    start, stop = int(cache.num_voxels), int(share * cache.capacity)
    cells = np.arange(max(stop - start, 0))
    voxels = np.stack([cells % 512, cells // 512, np.full_like(cells, 100)], axis=-1)
    rows = start + jnp.asarray(cells, jnp.int32)
    table = jax.jit(insert_rows)(cache.table, jnp.asarray(voxels, jnp.int32), rows, jnp.ones(len(cells), bool))
    return replace(
        cache,
        voxels=cache.voxels.at[rows].set(jnp.asarray(voxels, jnp.int32)),
        counts=cache.counts.at[rows].set(config.memory.pivots_per_voxel),
        num_voxels=jnp.asarray(max(start, stop), jnp.int32),
        table=table,
    )


def _filled(config: StreamConfig, capacity: int, num_rows: int, num_in_sight: int | None = None) -> VoxelCache:
    """A cache whose pivots fill the space before `_cameras`, or with `num_in_sight` that and the space behind them."""
    rng = np.random.default_rng(0)
    sides = rng.permutation(np.where(np.arange(num_rows) < (num_in_sight or num_rows), 1.0, -1.0))
    k, cache = config.memory.pivots_per_voxel, init_cache(config, capacity)
    values = {
        "means": rng.uniform([-2.0, -1.5, 1.0], [2.0, 1.5, 4.0], (num_rows, k, 3)) * sides[:, None, None],
        "feats": rng.normal(size=(num_rows, k, config.network.token_width)),
        "confidences": rng.uniform(config.memory.min_confidence, 1.0, (num_rows, k)),
    }
    filled = {name: getattr(cache, name).at[:num_rows].set(jnp.asarray(x, jnp.float32)) for name, x in values.items()}
    counts = cache.counts.at[:num_rows].set(k)
    return replace(cache, counts=counts, num_voxels=jnp.asarray(num_rows, jnp.int32), **filled)


def _cameras() -> Camera:
    """Four views of 60 x 80 cells from the origin, 0.1 units from each other."""
    viewmats = np.tile(np.eye(4, dtype=np.float32), (4, 1, 1))
    viewmats[:, 0, 3] = [0.0, 0.1, 0.2, 0.3]
    K = np.array([[60.0, 0, 40.0], [0, 60.0, 30.0], [0, 0, 1]], np.float32)
    return Camera(viewmats=jnp.asarray(viewmats), Ks=jnp.asarray(np.tile(K, (4, 1, 1))), width=80, height=60)
