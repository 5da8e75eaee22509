"""Accuracy against time: PSNR of unseen views and milliseconds per view, one setting changed at a time.

    ssplat experiment accuracy_vs_time --captures path/to/captures --out runs/accuracy_vs_time

Every setting streams the same context views of `procedural:room` (and of redkitchen, where `--captures` has it) with
the shipped weights, no retraining, and is scored on the same targets at the same size, whatever size it streamed at.
Time is chunk in -> one novel view out on the full cache, warm. Writes `table.json`, `table.md` and `plot.png`,
row by row. Needs an idle machine: about 40 minutes on two cores.
"""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ssplat_experiments.scenes import REDKITCHEN, open_redkitchen, open_room
from ssplat_jax.checkpoint.weights import load_params
from ssplat_jax.config import preset
from ssplat_jax.console import Reporter
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.split import Split
from ssplat_jax.evaluation.latency import measure_latency
from ssplat_jax.evaluation.plots import import_pyplot, save_figure
from ssplat_jax.evaluation.scoring import score_targets
from ssplat_jax.storage.atomic import write_atomic
from ssplat_jax.storage.json_files import write_json
from ssplat_jax.streaming.feed import feed_capture
from ssplat_jax.streaming.session import Session
from ssplat_jax.streaming.streamsplat import StreamSplat

SCORED = (320, 240)
CONTEXT = {"full": 32, "smoke": 8}


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
    settings = SETTINGS if scale == "full" else SETTINGS[:2]
    scenes = _scenes(captures, CONTEXT[scale])
    if len(scenes) == 1:
        reporter.warn("no redkitchen under --captures: the procedural scene stands alone")
    rows: list[dict[str, Any]] = []
    with reporter.progress("measuring", len(settings) * len(scenes)) as advance:
        for setting in settings:
            for scene, opened in scenes.items():
                rows.append({"scene": scene} | measure(setting, opened))
                _write(out, rows)  # what an interrupted run has measured is kept
                advance(len(rows), f"{scene}, {setting.name}")
    return f"wrote {out}/table.json, table.md and plot.png: {len(rows)} measured settings"


def _write(out: Path, rows: list[dict[str, Any]]) -> None:
    """The table in two forms and the plot, with the front of the rows so far."""
    for scene in {row["scene"] for row in rows}:
        mark_front([row for row in rows if row["scene"] == scene])
    write_json(out / "table.json", rows)
    write_atomic(out / "table.md", _markdown(rows).encode())
    plot(out / "plot.png", rows)


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
        "step_memory_mb": round((session.step_memory_bytes or 0) / 2**20, 1),
    }


def mark_front(rows: list[dict[str, Any]]) -> None:
    """Sets `front` on every row: no other row of the scene is both faster and at least as good."""
    best = -np.inf
    for row in sorted(rows, key=lambda row: (row["ms_per_view"], -row["shown"])):
        row["front"] = bool(row["shown"] > best)
        best = max(best, row["shown"])


def _markdown(rows: list[dict[str, Any]]) -> str:
    """The table, fastest first within a scene; the front in bold."""
    lines = [
        "| scene | setting | shown PSNR dB | literal PSNR dB | ms per view | Gaussians | step memory MiB |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in sorted(rows, key=lambda row: (row["scene"], row["ms_per_view"])):
        name = f"**{_label(row)}**" if row["front"] else _label(row)
        cells = (
            row["scene"],
            name,
            f"{row['shown']:.2f}",
            f"{row['literal']:.2f}",
            row["ms_per_view"],
            row["gaussians"],
            row["step_memory_mb"],
        )
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines) + "\n"


def _label(row: dict[str, Any]) -> str:
    """The setting, and the quality that it is."""
    quality = {setting.name: setting.quality for setting in SETTINGS}.get(row["setting"])
    return f"{row['setting']} ({quality})" if quality else row["setting"]


def plot(path: Path, rows: list[dict[str, Any]]) -> None:
    """A panel per scene, the front as a line, the qualities ringed; names where there is room, the front's first.

    Left out without matplotlib (`plots` extra).
    """
    if (pyplot := import_pyplot()) is None:
        return
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
    save_figure(path, figure)
