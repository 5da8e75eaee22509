"""Cost of a stream: time of each stage from a chunk to a novel view; `context_length` has the memory by views.

    ssplat experiment cost --out runs/cost

A session streams `procedural:room`, then the last chunk is fed again to the full cache. Stages are timed as programs of
their own, so their sum differs from the whole by what XLA joins. Needs an idle machine.
"""

import dataclasses
import functools
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ssplat_experiments.cases import Case, Row
from ssplat_experiments.streams import START_CAPACITY, new_session
from ssplat_experiments.study import Study, at_scale, run_study
from ssplat_jax.cache.project import project
from ssplat_jax.config import StreamConfig, preset
from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.chunk import Chunk
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.evaluation.cost import measure_latency, peak_memory
from ssplat_jax.model.views import prepare_views
from ssplat_jax.rasterizer import render
from ssplat_jax.streaming.session import Session, feed_capture

STAGES = ("copy to device", "project the cache", "network", "fuse and vote", "decode", "render")
WHOLE = "as a stream runs it"


@dataclasses.dataclass(frozen=True)
class Sizes:
    """Sizes of the images (width, height), views that are streamed before stages are timed, and timings of each."""

    images: tuple[tuple[int, int], ...]
    views: int
    repeats: int


SIZES = {
    "smoke": Sizes(((64, 48),), 8, 1),
    "cpu": Sizes(((160, 120), (320, 240)), 24, 7),
    "gpu": Sizes(((256, 256), (448, 256), (960, 512)), 128, 20),
}


def cases(captures: Path | None, scale: str) -> list[Case]:
    """A case for each size of images."""
    sizes, config = at_scale(SIZES, scale), preset("tiny").replace(capacity=START_CAPACITY)
    return [
        Case(
            name=f"{size[0]}x{size[1]}",
            config=config,
            asked={"size": size, "views": sizes.views, "repeats": sizes.repeats},
            measure=functools.partial(stage_rows, config, size, sizes),
        )
        for size in sizes.images
    ]


def stage_rows(config: StreamConfig, size: tuple[int, int], sizes: Sizes) -> list[Row]:
    """A row for each stage, for their sum and for the whole, which has the memory."""
    capture = open_capture(f"procedural:room?frames={sizes.views}", size=size)
    stream_frame, session = capture.stream_frame(config), new_session(config)
    _, recent = feed_capture(session, capture, range(sizes.views), stream_frame, num_recent=2)
    camera, views = capture.camera(sizes.views // 2, stream_frame), config.stream.chunk_size
    parts = stage_times(session, recent[-1], camera, sizes.repeats)
    parts |= {"sum of stages": sum(parts.values())}
    parts |= {WHOLE: measure_latency(session, recent, camera)["chunk_ms"]["median"]}
    memory = peak_memory(session, camera)["peak_memory_bytes"]
    return [
        {
            "size": f"{size[0]}x{size[1]}",
            "stage": stage,
            "ms": round(ms, 2),
            "views_per_second": round(1e3 * views / ms, 1) if stage not in STAGES else None,
            "peak_memory_bytes": memory if stage == WHOLE else None,
        }
        for stage, ms in parts.items()
    ]


def stage_times(session: Session, chunk: Chunk, camera: Camera, repeats: int) -> dict[str, float]:
    """Median milliseconds of each of `STAGES`, run on its own.

    Args:
        session: a stream whose cache holds a scene; it keeps it.
        chunk: the chunk that arrives.
        camera: the view to render, in the stream frame.
        repeats: timings of each stage, after one that compiles.

    Returns:
        Milliseconds by stage.
    """
    model, params, cache = session.model, session.params, session.cache
    views = jax.jit(lambda chunk: prepare_views(chunk, model.config))(chunk)
    look = jax.jit(lambda cache, views: project(cache, views.grid_camera, model.config))
    predict, update = jax.jit(model.predict), jax.jit(model.update_cache, donate_argnums=0)
    received = jax.tree.map(np.asarray, chunk)
    prediction, gaussians = predict(params, cache, chunk), session.gaussians()
    timed = functools.partial(median_ms, repeats=repeats)
    looking, predicting = timed(lambda _: look(cache, views)), timed(lambda _: predict(params, cache, chunk))
    copies = lambda: jax.block_until_ready(jax.tree.map(jnp.copy, cache))  # noqa: E731
    return {
        "copy to device": timed(lambda _: jax.tree.map(jnp.array, received)),
        "project the cache": looking,
        "network": max(predicting - looking, 0.0),
        "fuse and vote": timed(lambda copy: update(copy, prediction), prepare=copies),
        "decode": timed(lambda _: session.gaussians()),
        "render": timed(lambda _: render(gaussians, camera)),
    }


def median_ms(work: Callable[[Any], Any], repeats: int, prepare: Callable[[], Any] = lambda: None) -> float:
    """Median milliseconds of `work(prepare())`, after one run that compiles; `prepare` is not timed."""
    times = []
    for _ in range(repeats + 1):
        prepared = prepare()
        since = time.perf_counter()
        jax.block_until_ready(work(prepared))
        times.append(1e3 * (time.perf_counter() - since))
    return statistics.median(times[1:])


STUDY = Study(
    name="cost",
    text="Milliseconds from a chunk received to one novel view rendered, on the cache of the whole stream, by stage.",
    cases=cases,
)

run = functools.partial(run_study, STUDY)
