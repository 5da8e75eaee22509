"""`ssplat bench NAME`: benchmarks in one form, `{machine, date, commit, rows: [{name, value, unit}]}`."""

import dataclasses
import itertools
import statistics
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from ssplat_jax.benchmarks.cache_benchmark import Row, bench_cache
from ssplat_jax.benchmarks.rasterizer_benchmark import bench_render
from ssplat_jax.benchmarks.refine_benchmark import bench_refine
from ssplat_jax.config import preset
from ssplat_jax.core.chunk import Chunk
from ssplat_jax.core.errors import InputError
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.evaluation.provenance import commit, machine, today
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.refinement import online_refinement
from ssplat_jax.storage.weights import load_params
from ssplat_jax.streaming.session import Session, tokens_per_chunk

BENCHMARKS = ("render", "refine", "stream")
"""Names of the benchmarks."""

NUM_FRAMES = 40
"""Frames of the walk that a benchmark's stream repeats."""


def run_benchmark(
    name: str, *, against: Path | None = None, scaling: bool = False, full_hd: bool = False
) -> dict[str, Any]:
    """The figures of a benchmark.

    Args:
        name: `render`, `refine` or `stream`.
        against: for `render` a rasterizer's file, see `bench_render`; for `refine` a checkout, see `bench_refine`.
        scaling, full_hd: for `render`; see `bench_render`.

    Returns:
        The machine, date and commit, and rows of name, value and unit.

    Raises:
        InputError: `name` is no benchmark or has no use for an argument, or `against` cannot be timed.
    """
    for option, is_given, users in (
        ("--scaling", scaling, ("render",)),
        ("--full-hd", full_hd, ("render",)),
        ("--against", against is not None, ("render", "refine")),
    ):
        if is_given and name in BENCHMARKS and name not in users:
            raise InputError(f"{option}: bench {name} has no use for it; leave it out.")
    if name == "render":
        rows = bench_render(against, scaling=scaling, full_hd=full_hd)
    elif name == "refine":
        rows = bench_refine(against)
    elif name == "stream":
        rows = [dataclasses.asdict(row) for row in (*bench_cache(preset("tiny")), *bench_step(), *bench_online())]
    else:
        raise InputError(f"bench: wanted one of {', '.join(BENCHMARKS)}, got {name!r}; choose one.")
    return {"machine": machine(), "date": today(), "commit": commit(), "rows": rows}


def bench_step() -> list[Row]:
    """The whole step with the shipped weights: speed at 320 x 240, and how it depends on the stream's age."""
    session, chunks = _session_and_chunks((320, 240))
    seconds = [_seconds(session, chunk) for chunk in chunks]
    step = statistics.median(seconds[1:])  # the first has compiled
    num_tokens = tokens_per_chunk(chunks[0], session.model.config.network.size_multiple)
    return [
        Row("step_320x240", step * 1e3, "ms"),
        Row("step_tokens_per_second", num_tokens / step, "1/s"),
        *bench_age("step"),
    ]


def bench_online(*, num_chunks: int = 2500) -> list[Row]:
    """Time and memory of a step with online refinement (`--online-refine 2`), late in a stream against early."""
    return bench_age("online", num_chunks=num_chunks, steps_per_chunk=2)


def bench_age(
    name: str,
    *,
    num_chunks: int = 2500,
    size: tuple[int, int] = (64, 48),
    repeats: int = 15,
    steps_per_chunk: int = 0,
) -> list[Row]:
    """Time and memory of a chunk late in a stream against those early in it.

    The stream repeats one walk through a room, with small images, since only the cache's part of a step could grow.
    Chunks on copies of the early and the late cache are timed alternately.

    Args:
        name: start of the names of the rows.
        num_chunks: chunks before the late age; the early one is ten.
        size: width and height of the images.
        repeats: timings of each age, of which the median counts.
        steps_per_chunk: steps of refinement after each chunk.

    Returns:
        One row for each figure.
    """
    session, chunks = _session_and_chunks(size, steps_per_chunk)
    caches, memory = [], []
    for number, chunk in enumerate(itertools.islice(itertools.cycle(chunks), num_chunks), 1):
        session.feed(chunk)
        if number in (10, num_chunks):
            caches.append(jax.tree.map(jnp.copy, session.cache))
            memory.append((session.step_memory_bytes or 0) + (session.refine_memory_bytes or 0))
    times: list[list[float]] = [[] for _ in caches]
    for _ in range(repeats):
        for cache, column in zip(caches, times, strict=True):
            session.cache = jax.tree.map(jnp.copy, cache)
            column.append(min(_seconds(session, chunk) for chunk in chunks[:3]))
    early, late = map(statistics.median, times)
    return [
        Row(f"{name}_late_chunk_over_early", late / early, "x", "<= 1.05"),
        Row(f"{name}_memory_bytes", float(memory[-1]), "B"),
        Row(f"{name}_memory_growth", float(memory[-1] - memory[0]), "B", "0"),
        Row(f"{name}_compilations", float(session.num_compilations), "", "2" if steps_per_chunk else "1"),
    ]


def _session_and_chunks(size: tuple[int, int], steps_per_chunk: int = 0) -> tuple[Session, list[Chunk]]:
    """A session whose cache keeps its capacity, and the chunks of one walk through a room."""
    model = StreamSplat(preset("tiny").replace(overflow="drop_new", steps_per_chunk=steps_per_chunk))
    capture = open_capture(f"procedural:room?frames={NUM_FRAMES}", size=size)
    indices = tuple(range(NUM_FRAMES))
    frame = capture.stream_frame(model.config, indices)
    session = Session(model, load_params("tiny"), revise=online_refinement(model))
    return session, list(capture.chunks(model.config, indices, frame=frame))


def _seconds(session: Session, chunk: Chunk) -> float:
    start = time.perf_counter()
    session.feed(chunk)
    return time.perf_counter() - start
