"""Cost of a stream: time of each stage, and peak memory against the number of views (the paper's Figure 1).

    ssplat experiment cost --out runs/cost

`latency`: a session streams `procedural:room`, then the last chunk is fed again to the full cache. Stages are timed as
programs of their own, so their sum differs from the whole by what XLA joins. `memory`: ours, a memory that keeps every
token (`append-all`), and the same network over all views at once (`joint`). `ours` and `append-all` walk through `loop`
views again and again, so that the stream grows and the scene does not; the others see new views, since a network that
sees a view twice finds no parallax. On a CPU bytes are those of XLA's analysis; on a GPU each number of views runs in a
process of its own, and its allocator counts. Needs an idle machine.
"""

import dataclasses
import functools
import multiprocessing
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ssplat_experiments.baselines import JointNetwork, joint_config, one_chunk
from ssplat_experiments.cases import Case, Row
from ssplat_experiments.streams import START_CAPACITY, new_session
from ssplat_experiments.study import Study, at_scale, run_study
from ssplat_jax.cache.project import project
from ssplat_jax.config import StreamConfig, preset
from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.chunk import Chunk
from ssplat_jax.core.console import Reporter
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.evaluation.cost import measure_latency, peak_memory
from ssplat_jax.model.views import prepare_views
from ssplat_jax.rasterizer import render
from ssplat_jax.storage.weights import load_params
from ssplat_jax.streaming.feed import feed_capture, feed_chunks
from ssplat_jax.streaming.session import Session

STAGES = ("copy to device", "project the cache", "network", "fuse and vote", "decode", "render")
WHOLE = "as a stream runs it"
METHODS = ("ours", "ours, new views", "append-all", "joint")
REPEATING = ("ours", "append-all")


@dataclasses.dataclass(frozen=True)
class Sizes:
    """Sizes of both studies; image sizes are (width, height)."""

    images: tuple[tuple[int, int], ...]
    """Images of `latency`."""
    views: int
    """Views that are streamed before stages are timed."""
    repeats: int
    counts: tuple[int, ...]
    """Numbers of views of `memory`."""
    loop: int
    """Views of the walk that is repeated."""
    small: tuple[int, int]
    """Images of `memory`."""


SIZES = {
    "smoke": Sizes(((64, 48),), 8, 1, (8,), 8, (64, 48)),
    "cpu": Sizes(((160, 120), (320, 240)), 24, 7, (16, 32, 64, 128), 16, (96, 72)),
    "gpu": Sizes(((256, 256), (448, 256), (960, 512)), 128, 20, (24, 64, 128, 256, 512), 24, (480, 256)),
}


def run(captures: Path | None, out: Path, scale: str, reporter: Reporter) -> str:
    """Measures both, each in a folder of its own."""
    return "\n".join(run_study(study, captures, out / study.name, scale, reporter) for study in STUDIES)


def latency_cases(captures: Path | None, scale: str) -> list[Case]:
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
    frame, session = capture.stream_frame(config), new_session(config)
    _, recent = feed_capture(session, capture, range(sizes.views), frame, num_recent=2)
    camera, views = capture.camera(sizes.views // 2, frame), config.stream.chunk_size
    parts = stage_times(session, recent[-1], camera, sizes.repeats)
    parts |= {"sum of stages": sum(parts.values())}
    parts |= {WHOLE: measure_latency(session, recent, camera)["chunk_ms"]["median"]}
    memory = peak_memory(session, camera).bytes
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


def memory_config(method: str, num_views: int) -> StreamConfig:
    """Configuration of a method."""
    config = preset("tiny").replace(capacity=START_CAPACITY)
    if method == "joint":
        return joint_config(config, num_views)
    return config.replace(vacc="append") if method == "append-all" else config


def memory_cases(captures: Path | None, scale: str) -> list[Case]:
    """A case for each method; joint networks, and processes of their own, take one number of views each."""
    sizes = at_scale(SIZES, scale)
    measure = in_own_process if scale == "gpu" else memory_rows
    return [
        Case(
            name=f"{method}, {' '.join(map(str, counts))} views",
            config=memory_config(method, counts[-1]),
            asked={"size": sizes.small, "loop": sizes.loop, "views": counts, "most": max(sizes.counts)},
            measure=functools.partial(measure, method, counts, sizes),
        )
        for method in METHODS
        for counts in ([(n,) for n in sizes.counts] if method == "joint" or scale == "gpu" else [sizes.counts])
    ]


def in_own_process(method: str, counts: tuple[int, ...], sizes: Sizes) -> list[Row]:
    """`memory_rows` in a fresh process, whose allocator has counted nothing else."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(memory_rows, (method, counts, sizes))


def memory_rows(method: str, counts: tuple[int, ...], sizes: Sizes) -> list[Row]:
    """The rows of a method: one stream that stops at each number of views."""
    most = max(sizes.counts)
    capture, config = (
        open_capture(f"procedural:room?frames={most}", size=sizes.small),
        memory_config(method, counts[-1]),
    )
    frame = capture.stream_frame(config, range(most))
    order = [i % sizes.loop if method in REPEATING else i for i in range(counts[-1])]
    session, rows, fed = new_session(config), [], 0
    for count in counts:
        camera = capture.camera(order[count // 2], frame)
        if method == "joint":
            chunk = one_chunk(list(capture.chunks(config, order[:count], frame=frame)))
            network = JointNetwork(config, load_params("tiny"), chunk)
            memory, shown = network.peak_memory(camera), int((network.gaussians().opacities > 0).sum())
        else:
            for _ in feed_chunks(session, capture, order[fed:count], frame):
                pass
            memory, shown = peak_memory(session, camera), session.cache_facts()["decoded"]
        rows.append({"method": method, "views": count, **memory.to_row(), "gaussians": shown})
        fed = count
    return rows


def growth(rows: list[Row], method: str) -> tuple[float, float]:
    """Factor by which a method's memory grows from the fewest views to the most, and bytes per added view."""
    curve = sorted((row["views"], row["peak_memory_bytes"]) for row in rows if row["method"] == method)
    (first, low), (last, high) = curve[0], curve[-1]
    return high / low, (high - low) / max(last - first, 1)


def memory_findings(rows: list[Row]) -> list[str]:
    """Growth of the memory of each method."""
    peaks = {m: [row["peak_memory_bytes"] for row in rows if row["method"] == m] for m in REPEATING}
    found = [] if peaks["ours"] != peaks["append-all"] else ["scenes of this scale fill no cache: both are alike."]
    for method in dict.fromkeys(row["method"] for row in rows):
        factor, per_view = growth(rows, method)
        found.append(f"{method}: {factor:.2f} x from the fewest views to the most, {per_view / 2**20:.2f} MiB a view.")
    return ["\n".join(f"* {line}" for line in found)]


LATENCY = Study(
    name="latency",
    text="Milliseconds from a chunk received to one novel view rendered, on the cache of the whole stream, by stage.",
    cases=latency_cases,
)
MEMORY = Study(
    name="memory",
    text="Peak memory of step, decode and rendering together, in MiB, against the number of views.",
    cases=memory_cases,
    findings=memory_findings,
)
STUDIES = (LATENCY, MEMORY)
