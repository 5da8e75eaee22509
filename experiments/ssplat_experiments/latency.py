"""Time from a chunk received to one novel view rendered, split by stage, with frames per second.

    ssplat experiment latency --scale smoke --out runs/latency

A session streams `procedural:room`; then the last chunks are fed again to the full cache. The whole is timed as a
stream runs it: one program for the step, one for decoding, one for rendering. The stages are timed as programs of their
own, so their sum differs from the whole by what XLA joins or overlaps. Everything is compiled before it is timed, and
every result is waited for. Needs an idle machine.
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
from ssplat_experiments.memory_curve import START_CAPACITY
from ssplat_experiments.study import Study, at_scale, run_study
from ssplat_experiments.warm_sessions import new_session
from ssplat_jax.cache import project
from ssplat_jax.config import StreamConfig, preset
from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.chunk import Chunk
from ssplat_jax.core.console import Reporter
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.evaluation.cost import measure_latency, peak_memory
from ssplat_jax.model.views import prepare_views
from ssplat_jax.rasterizer import render
from ssplat_jax.streaming.feed import feed_capture
from ssplat_jax.streaming.session import Session

STAGES = ("copy to device", "project the cache", "network", "fuse and carve", "decode", "render")
WHOLE = "as a stream runs it"
COLORS = ("#909090", "#30507a", "#c06030", "#308050", "#806090", "#b09030")


@dataclasses.dataclass(frozen=True)
class Sizes:
    """Image sizes as (width, height), the views that are streamed before, and the timings of each stage."""

    images: tuple[tuple[int, int], ...]
    views: int
    repeats: int


SIZES = {
    "smoke": Sizes(((64, 48),), 8, 3),
    "cpu": Sizes(((160, 120), (320, 240)), 24, 7),
    "gpu": Sizes(((256, 256), (448, 256), (960, 512)), 128, 20),
}


def run(captures: Path | None, out: Path, scale: str, reporter: Reporter) -> str:
    """Times every size."""
    return run_study(STUDY, captures, out, scale, reporter)


def cases(captures: Path | None, scale: str) -> list[Case]:
    """A case for each size."""
    sizes, config = at_scale(SIZES, scale), preset("tiny").replace(capacity=START_CAPACITY)
    return [
        Case(
            name=f"{width}x{height}",
            config=config,
            asked={"size": [width, height], "views": sizes.views, "repeats": sizes.repeats},
            measure=functools.partial(measured, config, (width, height), sizes),
        )
        for width, height in sizes.images
    ]


def measured(config: StreamConfig, size: tuple[int, int], sizes: Sizes) -> list[Row]:
    """A row for each stage, for their sum and for the whole, which has the memory."""
    capture = open_capture(f"procedural:room?frames={sizes.views}", size=size)
    frame = capture.stream_frame(config)
    session = new_session(config)
    _, recent = feed_capture(session, capture, range(sizes.views), frame, num_recent=2)
    camera = capture.camera(sizes.views // 2, frame)
    whole = measure_latency(session, recent, camera)["chunk_ms"]["median"]
    parts = stage_times(session, recent[-1], camera, sizes.repeats)
    parts |= {"sum of stages": sum(parts.values()), WHOLE: whole}
    memory = peak_memory(session, camera).bytes
    views = config.stream.chunk_size
    width, height = size
    return [
        {
            "size": f"{width}x{height}",
            "stage": stage,
            "ms": round(ms, 2),
            "ms_per_view": round(ms / views, 2),
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
    assert cache is not None
    views = jax.jit(lambda chunk: prepare_views(chunk, model.config))(chunk)
    look = jax.jit(lambda cache, views: project(cache, views.grid_camera, model.config))
    predict, update = jax.jit(model.predict), jax.jit(model.update_cache, donate_argnums=0)
    received = jax.tree.map(np.asarray, chunk)
    prediction, gaussians = predict(params, cache, chunk), session.gaussians()
    timed = functools.partial(median_ms, repeats=repeats)
    looking = timed(lambda _: look(cache, views))
    predicting = timed(lambda _: predict(params, cache, chunk))
    copies = lambda: jax.block_until_ready(jax.tree.map(jnp.copy, cache))  # noqa: E731
    return {
        "copy to device": timed(lambda _: jax.tree.map(jnp.array, received)),
        "project the cache": looking,
        "network": max(predicting - looking, 0.0),
        "fuse and carve": timed(lambda copy: update(copy, prediction), prepare=copies),
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


def plot(pyplot: Any, rows: list[Row]) -> Any:
    """A bar for each size, in the colors of the stages; a line where the whole ends."""
    sizes = list(dict.fromkeys(row["size"] for row in rows))
    figure, axes = pyplot.subplots(figsize=(7, 1.2 + 0.6 * len(sizes)), layout="constrained")
    for place, size in enumerate(sizes):
        left = 0.0
        parts = {row["stage"]: row["ms"] for row in rows if row["size"] == size}
        for stage, color in zip(STAGES, COLORS, strict=True):
            axes.barh(place, parts[stage], left=left, color=color, label=stage if place == 0 else None)
            left += parts[stage]
        axes.plot([parts[WHOLE]] * 2, [place - 0.45, place + 0.45], color="black", lw=1.5)
    axes.set_yticks(range(len(sizes)), sizes)
    axes.set_xlabel("ms from a chunk to a novel view")
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=len(STAGES), fontsize=7)
    return figure


STUDY = Study(
    name="latency",
    text="""Milliseconds from a chunk received to one novel view rendered, on the cache of the whole stream. Each stage
is timed as a program of its own; the last row is the time as a stream runs it, with one program for the step, one for
decoding and one for rendering.""",
    cases=cases,
    plot=plot,
)
