"""`ssplat bench stream`: time and memory of whole steps, early and late in a stream, refined online and not.

The stream repeats one walk through a room, with small images, since only the cache's part of a step could grow. Chunks
on copies of the early and the late cache are timed alternately.
"""

import itertools
import statistics
import time
from typing import Any

import jax
import jax.numpy as jnp

from ssplat_jax.config import preset
from ssplat_jax.core.chunk import Chunk
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.refinement import online_refinement
from ssplat_jax.storage.weights import load_params
from ssplat_jax.streaming.session import Session, tokens_per_chunk

NUM_FRAMES = 40
"""Frames of the walk that the stream repeats."""


def run() -> list[dict[str, Any]]:
    """Rows of name, value and unit."""
    session, chunks = session_and_chunks((320, 240))
    step = statistics.median([_seconds(session, chunk) for chunk in chunks][1:])  # the first has compiled
    num_tokens = tokens_per_chunk(chunks[0], session.model.config.network.size_multiple)
    rows = [("step_320x240", step * 1e3, "ms"), ("step_tokens_per_second", num_tokens / step, "1/s")]
    rows += age_rows("step") + age_rows("online", steps_per_chunk=2)
    return [{"name": name, "value": value, "unit": unit} for name, value, unit in rows]


def age_rows(
    name: str,
    *,
    num_chunks: int = 2500,
    size: tuple[int, int] = (64, 48),
    repeats: int = 15,
    steps_per_chunk: int = 0,
) -> list[tuple[str, float, str]]:
    """Time and memory of a chunk after `num_chunks` chunks against those after ten; names begin with `name`."""
    session, chunks = session_and_chunks(size, steps_per_chunk)
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
        (f"{name}_late_chunk_over_early", late / early, "x"),
        (f"{name}_memory", float(memory[-1]), "B"),
        (f"{name}_memory_growth", float(memory[-1] - memory[0]), "B"),
        (f"{name}_compilations", float(session.num_compilations), ""),
    ]


def session_and_chunks(size: tuple[int, int], steps_per_chunk: int = 0) -> tuple[Session, list[Chunk]]:
    """A session whose cache keeps its capacity, and the chunks of one walk through a room."""
    model = StreamSplat(preset("tiny").replace(overflow="drop_new", steps_per_chunk=steps_per_chunk))
    capture = open_capture(f"procedural:room?frames={NUM_FRAMES}", size=size)
    frame = capture.stream_frame(model.config)
    session = Session(model, load_params("tiny"), revise=online_refinement(model))
    return session, list(capture.chunks(model.config, tuple(range(NUM_FRAMES)), frame=frame))


def _seconds(session: Session, chunk: Chunk) -> float:
    start = time.perf_counter()
    session.feed(chunk)
    return time.perf_counter() - start
