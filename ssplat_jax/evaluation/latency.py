"""Time from a chunk to a novel view."""

import time

import jax
import jax.numpy as jnp
import numpy as np

from ssplat_jax.cache import ensure_capacity
from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.chunk import Chunk
from ssplat_jax.rasterizer import render
from ssplat_jax.streaming.session import Session, tokens_per_chunk

NUM_CHUNKS = 4
"""The last chunks of a stream that an evaluation feeds again to the full cache to time them."""

NUM_REPEATS = 3
"""Measurements per chunk."""


def measure_latency(session: Session, chunks: list[Chunk], camera: Camera) -> dict:
    """Milliseconds from a chunk to a novel view on the full cache, and of the step and the rendering in it.

    The step takes the same time at every length of a stream; decoding and rendering grow with the scene.

    Everything is compiled before it is timed, and every result is waited for. The session keeps its cache.

    Returns:
        `chunk_ms`, with `median` and `p99`, and the medians `step_ms` and `render_ms`.
    """
    totals, steps, renders = [], [], []
    cache, config = session.cache, session.model.config
    assert cache is not None
    # Growing happens a few times in a stream's life and is not part of a chunk's cost.
    grown = ensure_capacity(cache, config, tokens_per_chunk(chunks[0], config.network.size_multiple))
    for chunk in chunks:
        for repeat in range(NUM_REPEATS + 1):
            session.cache = jax.block_until_ready(jax.tree.map(jnp.copy, grown))
            since = time.perf_counter()
            session.feed(chunk)
            jax.block_until_ready(session.cache)
            stepped = time.perf_counter()
            gaussians = jax.block_until_ready(session.gaussians())
            decoded = time.perf_counter()
            jax.block_until_ready(render(gaussians, camera).color)
            done = time.perf_counter()
            if repeat:  # the first may compile the renderer for this number of pairs
                totals.append(1e3 * (done - since))
                steps.append(1e3 * (stepped - since))
                renders.append(1e3 * (done - decoded))
    session.cache = cache
    return {
        "chunk_ms": {"median": round(float(np.median(totals)), 1), "p99": round(float(np.quantile(totals, 0.99)), 1)},
        "step_ms": round(float(np.median(steps)), 1),
        "render_ms": round(float(np.median(renders)), 1),
    }
