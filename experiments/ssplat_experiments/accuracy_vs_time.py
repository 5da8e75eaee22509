"""Accuracy against time: PSNR of unseen views and milliseconds per view, one setting changed at a time.

    ssplat experiment accuracy_vs_time --captures path/to/captures --out runs/accuracy_vs_time

Every setting streams the same context views of `procedural:room` (and of redkitchen, where `--captures` has it) with
the shipped weights, no retraining, and is scored on the same targets at the same size, whatever size it streamed at.
Time is chunk in -> one novel view out on the full cache, warm. Writes `table.json`, `table.csv`, `page.md` and
`plot.png`; what `--out` holds is not measured again. Needs an idle machine: about 40 minutes on two cores.
"""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ssplat_experiments.cases import Case, Row
from ssplat_experiments.scenes import REDKITCHEN, open_redkitchen, open_room
from ssplat_experiments.study import Study, at_scale, run_study
from ssplat_jax.checkpoint.weights import load_params
from ssplat_jax.config import preset
from ssplat_jax.console import Reporter
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.split import Split
from ssplat_jax.evaluation.latency import measure_latency
from ssplat_jax.evaluation.scoring import score_targets
from ssplat_jax.streaming.feed import feed_capture
from ssplat_jax.streaming.session import Session
from ssplat_jax.streaming.streamsplat import StreamSplat

SCORED = (320, 240)
CONTEXT = {"cpu": 32, "smoke": 8}


@dataclasses.dataclass(frozen=True)
class Setting:
    """A point of the plot: the size that is streamed and what differs from the preset."""

    name: str
    size: tuple[int, int] = SCORED
    changes: dict[str, Any] = dataclasses.field(default_factory=dict)
    quality: str = ""
    """Name of the `--quality` with this setting, or empty."""


SETTINGS = (
    Setting("preset", quality="accurate"),
    Setting("160x120", (160, 120), quality="fast"),
    Setting("240x180", (240, 180), quality="balanced"),
    Setting("480x360", (480, 360)),
    Setting("480x360, voxel 0.02", (480, 360), {"voxel_size": 0.02}),
    Setting("160x120, 1 source", (160, 120), {"num_sources": 1}),
    Setting("1 source", changes={"num_sources": 1}),
    Setting("1 Gaussian a token", changes={"gaussians_per_token": 1}),
    Setting("16 Gaussians a token", changes={"gaussians_per_token": 16}),
    Setting("exposure not matched", changes={"match_exposure": False}),
    Setting("1 pivot", changes={"pivots_per_voxel": 1}),
    Setting("chunks of 2", changes={"chunk_size": 2}),
    Setting("chunks of 8", changes={"chunk_size": 8}),
    Setting("no HPDA", changes={"hpda": False}),
    Setting("no CGFI", changes={"cgfi": False}),
    Setting("no carving", changes={"carving": False}),
    Setting("no mixer", changes={"mixer_blocks": 0}),
)


def run(captures: Path | None, out: Path, scale: str, reporter: Reporter) -> str:
    """Measures every setting on every available scene; `smoke` takes the first two settings and 8 views."""
    if captures is None or not (captures / REDKITCHEN).is_dir():
        reporter.warn("no redkitchen under --captures: the procedural scene stands alone")
    return run_study(STUDY, captures, out, scale, reporter)


def cases(captures: Path | None, scale: str) -> list[Case]:
    """A case for every setting and scene."""
    settings = SETTINGS[:2] if scale == "smoke" else SETTINGS
    context = at_scale(CONTEXT, scale)
    return [
        Case(
            name=f"{scene}, {setting.name}",
            config=preset("tiny").replace(**setting.changes),
            asked={"scene": scene, "context": context, "size": setting.size, "scored": SCORED},
            measure=functools.partial(_measured, scene, setting, opened),
        )
        for setting in settings
        for scene, opened in _scenes(captures, context).items()
    ]


def _measured(scene: str, setting: Setting, opened: "Opened") -> list[Row]:
    return [{"scene": scene} | measure(setting, opened)]


Opened = Callable[[tuple[int, int]], tuple[Capture, Split]]
"""Opens a scene with images of a (width, height)."""


def _scenes(captures: Path | None, context: int) -> dict[str, Opened]:
    """The available scenes by name."""
    scenes: dict[str, Opened] = {"room": functools.partial(open_room, context)}
    if captures is not None and (captures / REDKITCHEN).is_dir():
        scenes[REDKITCHEN] = functools.partial(open_redkitchen, captures, context)
    return scenes


def measure(setting: Setting, opened: Opened) -> dict[str, Any]:
    """One row: quality and time of a setting on a scene."""
    session = Session(StreamSplat(preset("tiny").replace(**setting.changes)), load_params("tiny"))
    (capture, split), (scored, _) = opened(setting.size), opened(SCORED)
    frame = capture.stream_frame(session.model.config, split.context)
    exposures, recent = feed_capture(session, capture, split.context, frame, num_recent=2)
    scores = score_targets(session.gaussians(), scored, split.targets, frame, exposures)
    middle = split.targets[len(split.targets) // 2]
    latency = measure_latency(session, recent, scored.camera(middle, frame))
    views = session.model.config.stream.chunk_size
    return {
        "setting": setting.name,
        "shown": round(scores["shown"]["psnr"], 3),
        "literal": round(scores["literal"]["psnr"], 3),
        "ms_per_view": round(latency["chunk_ms"]["median"] / views, 1),
        "chunk_ms": latency["chunk_ms"]["median"],
        "render_ms": latency["render_ms"],
        "compile_s": round(session.compile_seconds, 1),
        "gaussians": session.cache_facts()["decoded"],
        "step_memory_bytes": session.step_memory_bytes,
    }


def mark_front(rows: list[Row]) -> None:
    """Sets `front` on every row: no other row of the scene is both faster and at least as good."""
    best = -np.inf
    for row in sorted(rows, key=lambda row: (row["ms_per_view"], -row["shown"])):
        row["front"] = bool(row["shown"] > best)
        best = max(best, row["shown"])


def mark_fronts(rows: list[Row]) -> None:
    """The front of every scene; the fastest rows first within a scene."""
    for scene in {row["scene"] for row in rows}:
        mark_front([row for row in rows if row["scene"] == scene])
    rows.sort(key=lambda row: (row["scene"], row["ms_per_view"]))


def _label(row: dict[str, Any]) -> str:
    """The setting, and the quality that it is."""
    quality = {setting.name: setting.quality for setting in SETTINGS}.get(row["setting"])
    return f"{row['setting']} ({quality})" if quality else row["setting"]


def plot(pyplot: Any, rows: list[Row]) -> Any:
    """A panel per scene, the front as a line, the qualities ringed; names where there is room, the front's first."""
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    figure, panels = pyplot.subplots(1, len(scenes), figsize=(7 * len(scenes), 5), layout="constrained", squeeze=False)
    for axes, scene in zip(panels[0], scenes, strict=True):
        here = [row for row in rows if row["scene"] == scene]
        times, psnrs = [r["ms_per_view"] for r in here], [r["shown"] for r in here]
        axes.set_xscale("log")
        axes.set_xlim(0.8 * min(times), 1.8 * max(times))
        ticks = [10**k * m for k in range(6) for m in (1, 2, 5) if min(times) <= 1.25 * 10**k * m <= 2 * max(times)]
        axes.set_xticks(ticks, [str(tick) for tick in ticks])
        axes.minorticks_off()
        axes.set_ylim(min(psnrs) - 0.3, max(psnrs) + 0.3)
        front = sorted((r for r in here if r["front"]), key=lambda r: r["ms_per_view"])
        axes.plot([r["ms_per_view"] for r in front], [r["shown"] for r in front], color="#c06030", lw=1.2, zorder=1)
        figure.draw_without_rendering()  # lays the panel out, so that names know where they are
        names = []
        for row in sorted(here, key=lambda r: (_label(r) == r["setting"], not r["front"], r["ms_per_view"])):
            color = "#c06030" if row["front"] else "#30507a"
            at = (row["ms_per_view"], row["shown"])
            axes.scatter(*at, s=18, color=color, zorder=2)
            is_quality = _label(row) != row["setting"]
            if is_quality:
                axes.scatter(*at, s=90, facecolors="none", edgecolors=color, zorder=2)
            weight = "bold" if is_quality else "normal"
            offset = {"textcoords": "offset points", "xytext": (6, 4), "fontsize": 7, "color": color, "weight": weight}
            name = axes.annotate(_label(row), at, **offset)
            box = name.get_window_extent()
            if any(box.overlaps(other) for other in names):
                name.remove()
            else:
                names.append(box)
        axes.set_xlabel("ms per view, chunk in to novel view out")
        axes.set_ylabel("PSNR of unseen views, dB")
        axes.set_title(scene)
        axes.spines[["top", "right"]].set_visible(False)
    return figure


STUDY = Study(
    name="accuracy_vs_time",
    text="""Every setting streams the same context views with the shipped weights and is scored on the same views at the
same size. Time is chunk in, one novel view out, on the full cache. `front`: no other setting of the scene is both
faster and at least as good.""",
    cases=cases,
    finish=mark_fronts,
    plot=plot,
)
