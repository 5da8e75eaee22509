"""Accuracy against time: PSNR of unseen views and milliseconds per view of many settings.

    ssplat experiment accuracy_vs_time --captures path/to/captures --out runs/accuracy_vs_time

Every setting streams the same context views of `procedural:room` (and of redkitchen, where `--captures` has it) with
the shipped weights, no retraining, and is scored on the same targets at the same size, whatever size it streamed at.
Time is chunk in -> one novel view out on the full cache, warm. Writes `table.json`, `table.csv`, `page.md`, `plot.png`
and `front.json`, the front over all scenes, from which `ssplat run --budget-ms` chooses; what `--out` holds is not
measured again. Needs an idle machine.
"""

import dataclasses
import functools
import statistics
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ssplat_experiments.cases import Case, Row
from ssplat_experiments.memory_curve import START_CAPACITY
from ssplat_experiments.scenes import REDKITCHEN, open_redkitchen, open_room
from ssplat_experiments.study import Study, at_scale, run_study
from ssplat_experiments.warm_sessions import new_session
from ssplat_jax.config import StreamConfig, preset
from ssplat_jax.console import Reporter
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.split import Split
from ssplat_jax.evaluation.latency import measure_latency
from ssplat_jax.evaluation.peak_memory import peak_memory
from ssplat_jax.evaluation.scoring import score_targets
from ssplat_jax.runs.time_budget import FrontPoint, front_of, reference_step_ms
from ssplat_jax.streaming.feed import feed_capture


@dataclasses.dataclass(frozen=True)
class Sizes:
    """Context views, and (width, height) of the scored images."""

    context: int
    scored: tuple[int, int]
    settings: int | None = None
    """Number of `SETTINGS` that are measured; None: all."""


SIZES = {
    "smoke": Sizes(8, (64, 48), settings=2),
    "cpu": Sizes(24, (160, 120)),
    "gpu": Sizes(64, (320, 240)),
}


@dataclasses.dataclass(frozen=True)
class Setting:
    """A point of the plot: the size that is streamed, as a factor, and what differs from the preset."""

    factor: float = 1.0
    """Size of the streamed images against that of the scored ones."""
    label: str = ""
    changes: dict[str, Any] = dataclasses.field(default_factory=dict)
    quality: str = ""
    """Name of the `--quality` with this setting, or empty."""

    @property
    def name(self) -> str:
        """The factor of the size, if it is not 1, and the label; `preset` without both."""
        size = "" if self.factor == 1 else f"size x {self.factor:g}"
        return ", ".join(part for part in (size, self.label) if part) or "preset"

    def size(self, scored: tuple[int, int]) -> tuple[int, int]:
        """(width, height) of the streamed images."""
        return round(self.factor * scored[0]), round(self.factor * scored[1])


SETTINGS = (
    Setting(quality="accurate"),
    Setting(0.5, quality="fast"),
    Setting(0.75, quality="balanced"),
    Setting(0.4),
    Setting(0.6),
    Setting(0.9),
    Setting(1.25),
    Setting(1.5),
    Setting(1.5, "voxel 0.02", {"voxel_size": 0.02}),
    Setting(0.4, "1 source", {"num_sources": 1}),
    Setting(0.5, "1 source", {"num_sources": 1}),
    Setting(0.75, "1 source", {"num_sources": 1}),
    Setting(1.0, "1 source", {"num_sources": 1}),
    Setting(1.25, "1 source", {"num_sources": 1}),
    Setting(1.0, "1 Gaussian a token", {"gaussians_per_token": 1}),
    Setting(0.5, "16 Gaussians a token", {"gaussians_per_token": 16}),
    Setting(0.75, "16 Gaussians a token", {"gaussians_per_token": 16}),
    Setting(1.0, "16 Gaussians a token", {"gaussians_per_token": 16}),
    Setting(1.0, "exposure not matched", {"match_exposure": False}),
    Setting(1.0, "1 pivot", {"pivots_per_voxel": 1}),
    Setting(1.0, "chunks of 2", {"chunk_size": 2}),
    Setting(1.0, "chunks of 8", {"chunk_size": 8}),
    Setting(0.75, "chunks of 8", {"chunk_size": 8}),
    Setting(1.0, "no HPDA", {"hpda": False}),
    Setting(1.0, "no CGFI", {"cgfi": False}),
    Setting(1.0, "no carving", {"carving": False}),
    Setting(1.0, "no mixer", {"mixer_blocks": 0}),
)


def run(captures: Path | None, out: Path, scale: str, reporter: Reporter) -> str:
    """Measures every setting on every available scene, and writes the front; `smoke` takes two settings."""
    if captures is None or not (captures / REDKITCHEN).is_dir():
        reporter.warn("no redkitchen under --captures: the procedural scene stands alone")
    return run_study(STUDY, captures, out, scale, reporter)


def cases(captures: Path | None, scale: str) -> list[Case]:
    """A case for every setting and scene."""
    sizes = at_scale(SIZES, scale)
    return [
        Case(
            name=f"{scene}, {setting.name}",
            config=_config(setting, sizes),
            asked={"scene": scene, "factor": setting.factor, **dataclasses.asdict(sizes)} | {"settings": None},
            measure=functools.partial(_measured, scene, setting, sizes, opened),
        )
        for setting in SETTINGS[: sizes.settings]
        for scene, opened in _scenes(captures, sizes.context).items()
    ]


def _config(setting: Setting, sizes: Sizes) -> StreamConfig:
    """The preset with the changes; a smoke run shares the programs of other experiments, whose memory starts small."""
    small = {} if sizes.settings is None else {"capacity": START_CAPACITY}
    return preset("tiny").replace(**setting.changes, **small)


def _measured(scene: str, setting: Setting, sizes: Sizes, opened: "Opened") -> list[Row]:
    return [{"scene": scene} | measure(setting, sizes, opened)]


Opened = Callable[[tuple[int, int]], tuple[Capture, Split]]
"""Opens a scene with images of a (width, height)."""


def _scenes(captures: Path | None, context: int) -> dict[str, Opened]:
    """The available scenes by name."""
    scenes: dict[str, Opened] = {"room": functools.partial(open_room, context)}
    if captures is not None and (captures / REDKITCHEN).is_dir():
        scenes[REDKITCHEN] = functools.partial(open_redkitchen, captures, context)
    return scenes


def measure(setting: Setting, sizes: Sizes, opened: Opened) -> dict[str, Any]:
    """One row: quality, time and memory of a setting on a scene."""
    session = new_session(_config(setting, sizes))
    compiled = session.compile_seconds
    (capture, split), (scored, _) = opened(setting.size(sizes.scored)), opened(sizes.scored)
    frame = capture.stream_frame(session.model.config, split.context)
    exposures, recent = feed_capture(session, capture, split.context, frame, num_recent=2)
    scores = score_targets(session.gaussians(), scored, split.targets, frame, exposures)
    camera = scored.camera(split.targets[len(split.targets) // 2], frame)
    latency = measure_latency(session, recent, camera)
    views = session.model.config.stream.chunk_size
    return {
        "setting": setting.name,
        "shown": round(scores["shown"]["psnr"], 3),
        "literal": round(scores["literal"]["psnr"], 3),
        "ms_per_view": round(latency["chunk_ms"]["median"] / views, 2),
        "chunk_ms": latency["chunk_ms"]["median"],
        "render_ms": latency["render_ms"],
        "reference_ms": round(reference_ms(), 3),
        "compile_s": round(session.compile_seconds - compiled, 1),
        "gaussians": session.cache_facts()["decoded"],
        "peak_memory_bytes": peak_memory(session, camera).bytes,
    }


@functools.cache
def reference_ms() -> float:
    """The reference step of `ssplat run --budget-ms` on this machine, timed once a process."""
    return reference_step_ms()


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


def front_file(rows: list[Row], scale: str) -> dict[str, Any]:
    """`front.json`: the front of the means over scenes, of the settings that all scenes have."""
    num_scenes, by_name = len({row["scene"] for row in rows}), {setting.name: setting for setting in SETTINGS}
    points = []
    for name in dict.fromkeys(row["setting"] for row in rows):
        here = [row for row in rows if row["setting"] == name]
        if len(here) == num_scenes:
            steps = statistics.mean(row["ms_per_view"] / row["reference_ms"] for row in here)
            shown = statistics.mean(row["shown"] for row in here)
            setting = by_name[name]
            points.append(FrontPoint(name, setting.factor, setting.changes, round(steps, 3), round(shown, 3)))
    origin = {name: rows[0][name] for name in ("machine", "date", "commit")}
    return {"front.json": front_of(at_scale(SIZES, scale).scored, points).to_dict() | origin}


def plot(pyplot: Any, rows: list[Row]) -> Any:
    """A panel per scene, the front as a line, the qualities ringed, memory as color; the front's points are named."""
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    figure, panels = pyplot.subplots(1, len(scenes), figsize=(7 * len(scenes), 5), layout="constrained", squeeze=False)
    mib = [(row["peak_memory_bytes"] or 0) / 2**20 for row in rows]
    norm = pyplot.matplotlib.colors.LogNorm(max(min(mib), 1.0), max(*mib, 2.0))
    for axes, scene in zip(panels[0], scenes, strict=True):
        here = [row for row in rows if row["scene"] == scene]
        _time_axis(axes, [row["ms_per_view"] for row in here])
        psnrs = [row["shown"] for row in here]
        axes.set_ylim(min(psnrs) - 0.3, max(psnrs) + 0.3)
        front = sorted((r for r in here if r["front"]), key=lambda r: r["ms_per_view"])
        axes.plot([r["ms_per_view"] for r in front], [r["shown"] for r in front], color="#c06030", lw=1.2, zorder=1)
        places = [[row[column] for row in here] for column in ("ms_per_view", "shown")]
        colors = [(row["peak_memory_bytes"] or 0) / 2**20 for row in here]
        dots = axes.scatter(*places, c=colors, s=28, norm=norm, cmap="viridis", zorder=2)
        figure.draw_without_rendering()  # lays the panel out, so that names know where they are
        _name_points(axes, here)
        axes.set_title(scene)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0, 0].set_ylabel("PSNR of unseen views as shown, dB")
    figure.colorbar(dots, ax=list(panels[0]), label="peak memory, MiB")
    return figure


def _time_axis(axes: Any, times: list[float]) -> None:
    """A logarithmic axis of milliseconds with round ticks."""
    axes.set_xscale("log")
    axes.set_xlim(0.8 * min(times), 1.8 * max(times))
    ticks = [10**k * m for k in range(6) for m in (1, 2, 5) if min(times) <= 1.25 * 10**k * m <= 2 * max(times)]
    axes.set_xticks(ticks, [str(tick) for tick in ticks])
    axes.minorticks_off()
    axes.set_xlabel("ms per view, chunk in to novel view out")


def _name_points(axes: Any, rows: list[Row]) -> None:
    """Rings and names of the qualities, then the names of the others, the front's first, while there is room."""
    names = []
    for row in sorted(rows, key=lambda r: (_label(r) == r["setting"], not r["front"], r["ms_per_view"])):
        at, is_quality = (row["ms_per_view"], row["shown"]), _label(row) != row["setting"]
        color = "#c06030" if row["front"] else "#30507a"
        if is_quality:
            axes.scatter(*at, s=110, facecolors="none", edgecolors=color, zorder=3)
        style = {"fontsize": 7, "color": color, "weight": "bold" if is_quality else "normal"}
        name = axes.annotate(_label(row), at, textcoords="offset points", xytext=(6, 4), **style)
        box = name.get_window_extent()
        if any(box.overlaps(other) for other in names):
            name.remove()
        else:
            names.append(box)


STUDY = Study(
    name="accuracy_vs_time",
    text="""Every setting streams the same context views with the shipped weights and is scored on the same views at the
same size. Time is chunk in, one novel view out, on the full cache. `front`: no other setting of the scene is both
faster and at least as good. `reference ms` is the step that `ssplat run --budget-ms` times.""",
    cases=cases,
    finish=mark_fronts,
    plot=plot,
    files=front_file,
)
