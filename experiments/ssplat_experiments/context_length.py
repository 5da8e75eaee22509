"""Quality, memory and time against the number of context views (the paper's Tables 1 and 2, Figure 1), with baselines.

    ssplat experiment context_length --captures path/to/captures --out runs/context_length

The targets are uniform over a trajectory, and the other frames are streamed in order; the stream stops at each number
of views and is scored. Suites are procedural walks and every capture in `--captures` that is long enough. `literal`
scores are those of the paper: over black, at the exposure of the scene. `shown` fills holes and carries the exposure
over. The baselines see the same frames: the nearest context view, the mean color, the nearest view warped by the depth
of our scene, a memory that keeps every token, and the same network over all views at once (`joint`).
"""

import dataclasses
import functools
import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ssplat_experiments.baselines import JointNetwork, baseline_scores, joint_config, one_chunk
from ssplat_experiments.cases import PICTURE, Case, Row
from ssplat_experiments.streams import START_CAPACITY, new_session
from ssplat_experiments.study import Study, at_scale, run_study
from ssplat_jax.config import StreamConfig, preset
from ssplat_jax.core.errors import is_out_of_memory
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.data.split import Split, paper_split
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.evaluation.cost import OOM, measure_latency, peak_memory
from ssplat_jax.evaluation.metrics import installed_lpips
from ssplat_jax.evaluation.scoring import ImageScore, mean_images, score_view
from ssplat_jax.storage.weights import load_params
from ssplat_jax.streaming.session import Exposures, feed_capture

OURS, APPEND, JOINT = "ours", "append-all", "joint"
NUM_TARGETS = 16
NUM_TIMED = 4  # last chunks that are timed at each number of views

_open_capture = functools.lru_cache(maxsize=1)(open_capture)  # the cases of a suite follow each other


@dataclasses.dataclass(frozen=True)
class Sizes:
    """Numbers of context views, procedural suites, image size and targets."""

    counts: tuple[int, ...]
    suites: tuple[str, ...]
    size: tuple[int, int]
    targets: int = NUM_TARGETS
    joint: int = 128  # most views of the joint network, whose memory grows with them
    label: str = ""  # end of the names of the suites, where a table has the same scene at another size


WALKS = ("room", "corridor", "orbit")
SIZES = {
    "smoke": (Sizes((8,), ("room",), (64, 48), targets=3),),
    "cpu": (
        Sizes((24, 64, 128), WALKS, (160, 120), joint=64),
        Sizes((24, 256, 512, 1024), ("room",), (96, 72), joint=0, label=", 96 x 72"),
        Sizes((256, 1024, 4096), ("room",), (96, 72), joint=0, label=", slow, 96 x 72"),
        Sizes((1024, 4096, 10_000), ("laps",), (96, 72), joint=0, label=", 96 x 72"),
        Sizes((64, 256, 512, 984), (), (160, 120), joint=0, label=", all frames"),  # captures of 1,000 frames or more
    ),
    "gpu": (
        Sizes((24, 64, 128), WALKS, (480, 256)),
        Sizes((24, 256, 512, 1024), ("room", "corridor"), (480, 256), joint=0, label=", long"),
        Sizes((24, 1024, 10_000), ("room",), (128, 96), joint=0, label=", 128 x 96"),
    ),
}


def cases(captures: Path | None, scale: str) -> list[Case]:
    """The cases of every size."""
    return [case for sizes in at_scale(SIZES, scale) for case in suite_cases(captures, sizes)]


def suite_cases(captures: Path | None, sizes: Sizes) -> list[Case]:
    """A case for each suite and memory at these sizes, and for each number of views of the joint network."""
    num_frames = max(sizes.counts) + sizes.targets
    paths = [f"procedural:{suite}?frames={num_frames}" for suite in sizes.suites]
    folders = sorted(path for path in captures.iterdir() if path.is_dir()) if captures is not None else []
    paths += [str(path) for path in folders if len(open_capture(path, size=sizes.size)) >= num_frames]
    config = preset("tiny").replace(capacity=START_CAPACITY)  # so that memory is what the scene needs
    methods = {OURS: config, APPEND: config.replace(vacc="append")}
    not_asked = ("suites", "joint", "label")
    asked = {name: value for name, value in dataclasses.asdict(sizes).items() if name not in not_asked}
    streams = [
        Case(
            name=f"{_suite(path)}{sizes.label}, {method}",
            config=config,
            asked={"suite": _suite(path), **asked},
            measure=functools.partial(measured, path, method, config, sizes),
        )
        for path in paths
        for method, config in methods.items()
    ]
    counts = [count for count in sizes.counts if count <= sizes.joint]
    joint = [
        Case(
            name=f"{_suite(path)}{sizes.label}, {JOINT}",
            config=joint_config(config, counts[-1]),
            asked={"suite": _suite(path), **asked, "counts": counts},
            measure=functools.partial(measured_joint, path, counts, config, sizes),
        )
        for path in (paths if counts else ())
    ]
    return streams + joint


def measured(path: str, method: str, config: StreamConfig, sizes: Sizes) -> list[Row]:
    """A row for each number of views; with our memory, one for each image baseline too."""
    found = _stream(path, method, config, sizes)
    return until_full(found, sizes.counts, {"suite": _suite(path) + sizes.label, "method": method})


def until_full(found: Iterator[list[Row]], counts: Sequence[int], place: Row) -> list[Row]:
    """Rows of each number of views; the first that does not fit is `OOM`, and nothing larger is tried."""
    rows: list[Row] = []
    for count in counts:
        here = place | {"views": count}
        try:
            rows += [here | row for row in next(found)]
        except RuntimeError as error:
            if not is_out_of_memory(error):
                raise
            return [*rows, here | {"peak_memory_bytes": OOM}]
    return rows


def _stream(path: str, method: str, config: StreamConfig, sizes: Sizes) -> Iterator[list[Row]]:
    capture, split, stream_frame = _opened(path, config, sizes)
    session, exposures = new_session(config), {}
    middle = capture.camera(split.targets[len(split.targets) // 2], stream_frame)
    for fed, count in itertools.pairwise((0, *sizes.counts)):
        found, recent = feed_capture(session, capture, split.context[fed:count], stream_frame, num_recent=NUM_TIMED)
        exposures |= found
        seen = split.context[:count] if method == OURS else ()
        scored, color = _scores(session.gaussians(), capture, split.targets, stream_frame, exposures, seen)
        memory, latency = peak_memory(session, middle), measure_latency(session, recent, middle)
        cost = {
            "step_ms": latency["step_ms"],
            "chunk_ms": latency["chunk_ms"]["median"],
            "gaussians": session.cache_facts()["decoded"],
            **memory,
        }
        row = scored.pop("scene") | cost | ({PICTURE: color} if method == OURS else {})
        yield [row, *({"method": name, **scores} for name, scores in scored.items())]


def measured_joint(path: str, counts: Sequence[int], config: StreamConfig, sizes: Sizes) -> list[Row]:
    """A row of the joint network for each number of views."""
    found = ([joint_row(path, count, config, sizes)] for count in counts)
    return until_full(found, counts, {"suite": _suite(path) + sizes.label, "method": JOINT})


def joint_row(path: str, count: int, config: StreamConfig, sizes: Sizes) -> Row:
    """Scores and memory of the joint network over the first views, the chunk of the stream `config`."""
    capture, split, stream_frame = _opened(path, config, sizes)
    chunk = one_chunk(list(capture.chunks(config, split.context[:count], stream_frame=stream_frame)))
    network = JointNetwork(config, load_params("tiny"), chunk)
    gaussians = network.gaussians()
    scored = _scores(gaussians, capture, split.targets, stream_frame, {}, ())[0]["scene"]
    middle = capture.camera(split.targets[len(split.targets) // 2], stream_frame)
    cost = {"gaussians": int((gaussians.opacities > 0).sum()), **network.peak_memory(middle)}
    return {**scored, **cost}


def _opened(path: str, config: StreamConfig, sizes: Sizes) -> tuple[Capture, Split, StreamFrame]:
    """Capture, split, and the stream frame of the whole context: near and far are known, as the paper has them."""
    capture = _open_capture(path, size=sizes.size)
    split = paper_split(len(capture), max(sizes.counts), targets=sizes.targets)
    return capture, split, capture.stream_frame(config, split.context)


def _suite(path: str) -> str:
    return Path(path).name.removeprefix("procedural:").partition("?")[0]


def _scores(
    gaussians: Gaussians,
    capture: Capture,
    targets: Sequence[int],
    stream_frame: StreamFrame,
    exposures: Exposures,
    context: Sequence[int],
) -> tuple[dict[str, dict[str, float | None]], np.ndarray]:
    """Mean scores of the scene and, with a context, of the image baselines, by name; and the middle target as shown."""
    found: dict[str, list[dict[str, ImageScore]]] = {"scene": []}
    colors = []
    for i in targets:
        view = score_view(gaussians, capture, i, stream_frame, exposures, installed_lpips())
        colors.append(view.color)
        found["scene"].append({"literal": view.score.literal, "shown": view.score.shown})
        if context:
            for name, scores in baseline_scores(capture, i, context, stream_frame, view.depth, exposures).items():
                found.setdefault(name, []).append(scores)
    means = {
        name: {
            f"{column}_{metric}": value
            for column in ("literal", "shown")
            for metric, value in mean_images([score[column] for score in scores]).items()
        }
        for name, scores in found.items()
    }
    return means, colors[len(colors) // 2]


def plot(pyplot: Any, rows: list[Row]) -> Any:
    """Peak memory and literal PSNR against the number of views, a color a suite; every token kept is dashed."""
    figure, panels = pyplot.subplots(1, 2, figsize=(12, 4.5), layout="constrained")
    for color, suite in enumerate(dict.fromkeys(row["suite"] for row in rows)):
        for method, style in ((OURS, "o-"), (APPEND, "s--")):
            here = [row for row in rows if (row["suite"], row["method"]) == (suite, method) and "literal_psnr" in row]
            views = [row["views"] for row in here]
            panels[0].plot(views, [row["peak_memory_bytes"] / 2**20 for row in here], style, color=f"C{color}")
            label = f"{suite}, {method}"
            panels[1].plot(views, [row["literal_psnr"] for row in here], style, color=f"C{color}", label=label)
    for axes, text in zip(panels, ("peak memory, MiB", "literal PSNR of unseen views, dB"), strict=True):
        axes.set(xscale="log", xlabel="context views", ylabel=text)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_yscale("log")
    panels[1].legend(fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5))
    return figure


STUDY = Study(
    name="context_length",
    text="""One stream stops at each number of views; targets are uniform over the trajectory and never streamed.
`literal`: over black, at the exposure of the scene, as the paper scores. `shown`: holes filled and the exposure of
the nearest views. `step ms` is the time of a step alone, which is that of the stream; `chunk ms` has decoding and
one rendered view in it, which grow with the scene. `append-all` keeps every token, `joint` runs the same network
over all views at once, and `warp nearest` moves the nearest context view by the depth of our scene. Peak memory is
that of step, decode and rendering, in MiB.""",
    cases=cases,
    plot=plot,
)

run = functools.partial(run_study, STUDY)
