"""Peak memory of step, decode and rendering against the number of views (the paper's Figure 1).

    ssplat experiment memory_curve --scale smoke --out runs/memory_curve

Three methods take in the same views of `procedural:room`: ours, ours with a memory that keeps every token
(`vacc="append"`), and the same network over all views at once, which is what a fixed-view method does. The streams walk
through `Sizes.loop` views again and again, so that the stream grows and the scene does not. `ours, new views` and
`joint` see new views all the time: a joint network that sees a view twice finds no parallax between the two. On a CPU
the bytes are those of XLA's analysis (`ssplat_jax/evaluation/cost.py`); on a GPU each number of views runs in a
process of its own, and its allocator counts.
"""

import dataclasses
import functools
import multiprocessing
from pathlib import Path
from typing import Any

from ssplat_experiments.cases import Case, Row
from ssplat_experiments.joint_network import JointNetwork, joint_config, one_chunk
from ssplat_experiments.study import Study, at_scale, run_study
from ssplat_experiments.warm_sessions import new_session
from ssplat_jax.config import StreamConfig, preset
from ssplat_jax.core.console import Reporter
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.evaluation.cost import peak_memory
from ssplat_jax.storage.weights import load_params
from ssplat_jax.streaming.feed import feed_chunks

START_CAPACITY = 128
"""Both memories start as small as they can and double when needed, so that the curve shows what a scene needs."""

CHUNK = 4
REPEATING = ("ours", "append-all")
"""The methods that see the views of the walk again and again."""

METHODS = ("ours", "ours, new views", "append-all", "joint")
COLORS = {"ours": "#c06030", "ours, new views": "#e0b090", "append-all": "#30507a", "joint": "#308050"}


@dataclasses.dataclass(frozen=True)
class Sizes:
    """Numbers of views, and the size of the images."""

    counts: tuple[int, ...]
    loop: int
    """Views of the walk that is repeated."""
    width: int
    height: int


SIZES = {
    "smoke": Sizes((8, 16), 8, 64, 48),
    "cpu": Sizes((16, 32, 64, 128), 16, 96, 72),
    "gpu": Sizes((24, 64, 128, 256, 512), 24, 480, 256),
}


def run(captures: Path | None, out: Path, scale: str, reporter: Reporter) -> str:
    """Measures every method at every number of views."""
    return run_study(STUDY, captures, out, scale, reporter)


def config_of(method: str, num_views: int) -> StreamConfig:
    """Configuration of a method."""
    config = preset("tiny").replace(chunk_size=CHUNK, capacity=START_CAPACITY)
    if method == "joint":
        return joint_config(config, num_views)
    return config.replace(vacc="append") if method == "append-all" else config


def cases(captures: Path | None, scale: str) -> list[Case]:
    """A case for each method; joint networks, and processes of their own, take one number of views each."""
    sizes = at_scale(SIZES, scale)
    measure = in_own_process if scale == "gpu" else measured
    found = []
    for method in METHODS:
        is_single = method == "joint" or scale == "gpu"
        for counts in [(count,) for count in sizes.counts] if is_single else [sizes.counts]:
            found.append(
                Case(
                    name=f"{method}, {' '.join(map(str, counts))} views",
                    config=config_of(method, counts[-1]),
                    asked={
                        "capture": _spec(sizes),
                        "size": [sizes.width, sizes.height],
                        "loop": sizes.loop,
                        "views": counts,
                    },
                    measure=functools.partial(measure, method, counts, sizes),
                )
            )
    return found


def in_own_process(method: str, counts: tuple[int, ...], sizes: Sizes) -> list[Row]:
    """`measured` in a fresh process, whose allocator has counted nothing else."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(measured, (method, counts, sizes))


def _spec(sizes: Sizes) -> str:
    return f"procedural:room?frames={max(sizes.counts)}"


@functools.lru_cache(maxsize=1)
def _open(sizes: Sizes) -> Capture:
    return open_capture(_spec(sizes), size=(sizes.width, sizes.height))


def measured(method: str, counts: tuple[int, ...], sizes: Sizes) -> list[Row]:
    """The rows of a method: the first views of the capture, in one stream that stops at each number of them."""
    capture, config, params = _open(sizes), config_of(method, counts[-1]), load_params("tiny")
    frame = capture.stream_frame(config, range(max(sizes.counts)))
    order = [i % sizes.loop if method in REPEATING else i for i in range(counts[-1])]
    session, rows, fed = new_session(config), [], 0
    for count in counts:
        camera = capture.camera(order[count // 2], frame)
        if method == "joint":
            network = JointNetwork(config, params, one_chunk(list(capture.chunks(config, order[:count], frame=frame))))
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


def findings(rows: list[Row]) -> list[str]:
    """Growth of the memory of each method."""
    counts = sorted({row["views"] for row in rows})
    found = []
    peaks = {m: [row["peak_memory_bytes"] for row in rows if row["method"] == m] for m in ("ours", "append-all")}
    if peaks["ours"] == peaks["append-all"]:
        found.append("The scenes of this scale fill no cache, so `ours` and `append-all` do not differ.")
    for method in dict.fromkeys(row["method"] for row in rows):
        factor, slope = growth(rows, method)
        found.append(
            f"{method}: {factor:.2f} x from {counts[0]} to {counts[-1]} views, {slope / 2**20:.2f} MiB a view."
        )
    return ["\n".join(f"* {line}" for line in found)]


def plot(pyplot: Any, rows: list[Row]) -> Any:
    """A curve for each method."""
    figure, axes = pyplot.subplots(figsize=(6, 4), layout="constrained")
    for method in METHODS:
        curve = sorted((row["views"], row["peak_memory_bytes"] / 2**20) for row in rows if row["method"] == method)
        axes.plot(*zip(*curve, strict=True), marker="o", ms=4, color=COLORS[method], label=method)
    axes.set_xlabel("views")
    axes.set_ylabel("peak memory of step, decode and render, MiB")
    axes.set_ylim(bottom=0)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False)
    return figure


STUDY = Study(
    name="memory_curve",
    text="""Peak memory of step, decode and rendering together, against the number of views, in MiB. `ours` merges
tokens by voxel, `append-all` keeps every token, `joint` runs the same network over all views at once. `ours` and
`append-all` stream one walk again and again, so the scene stays as it is; `ours, new views` and `joint` see new views
all the time. The cache starts with space for four chunks of tokens and doubles before a chunk that might not fit.
While a step runs, its parameters, cache, images and temporaries count.""",
    cases=cases,
    plot=plot,
    findings=findings,
)
