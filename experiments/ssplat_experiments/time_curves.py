"""Curves of quality against seconds: the best so far at each time, where curves cross, and the plot."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ssplat_experiments.cases import Row

OPTIMIZED = "per-scene optimization"
COLUMNS = {"literal": "literal_psnr", "shown": "shown_psnr"}
TIMES = (1, 3, 10, 30, 60, 150, 300, 600)
"""Seconds of the table of `at_times`."""

COLORS = ("#30507a", "#c06030", "#3a8a5a", "#8a5a9a", "#b09030")


def best_at(rows: Sequence[Row], seconds: float, column: str) -> float:
    """The best score of some curves that was reached by a time; -inf before the first."""
    return max((row[column] for row in rows if row["seconds"] <= seconds), default=-np.inf)


def lead(rows: Sequence[Row], column: str) -> float | None:
    """The first time from which per-scene optimization leads to the end of all curves, or None if it does not.

    Rows are those of one scene. Each curve counts with the best that it has reached so far.
    """
    theirs = [row for row in rows if row["method"] == OPTIMIZED]
    ours = [row for row in rows if row["method"] != OPTIMIZED]
    times = sorted({row["seconds"] for row in rows})
    leads = [best_at(theirs, t, column) - best_at(ours, t, column) for t in times]
    behind = [t for t, gap in zip(times, leads, strict=True) if not gap > 0]
    after = [t for t in times if not behind or t > behind[-1]]
    return after[0] if after else None


def findings(rows: list[Row]) -> list[str]:
    """The table of `at_times`; then a line for each scene and column on who leads, until when and by how much."""
    lines = []
    for scene in dict.fromkeys(row["scene"] for row in rows):
        here = [row for row in rows if row["scene"] == scene]
        methods = {row["method"] for row in here}
        if OPTIMIZED not in methods or len(methods) < 2:
            continue
        for name, column in COLUMNS.items():
            crossing = lead(here, column)
            first = min((row for row in here if row["method"] != OPTIMIZED), key=lambda row: row["seconds"])
            ours = [row for row in here if row["method"] != OPTIMIZED]
            best = max(ours, key=lambda row: row[column])
            theirs = max((row for row in here if row["method"] == OPTIMIZED), key=lambda row: row[column])
            where = (
                "per-scene optimization does not lead in the end"
                if crossing is None
                else f"per-scene optimization leads from {crossing:.1f} s on"
            )
            lines.append(
                f"* {scene}, {name}: {where}; ours has its first score, {first[column]:.2f} dB, after"
                f" {first['seconds']:.1f} s and its best, {best[column]:.2f} dB ({best['method']}), after"
                f" {best['seconds']:.1f} s; per-scene optimization has its best, {theirs[column]:.2f} dB"
                f" ({theirs[column] - best[column]:+.2f} dB against the best of ours), after {theirs['seconds']:.1f} s."
            )
    return [at_times(rows), "\n".join(lines)] if lines else []


def at_times(rows: Sequence[Row]) -> str:
    """A Markdown table: the best scores of ours and of per-scene optimization up to each of `TIMES`, in dB.

    "(ended)" says that per-scene optimization had its last score before.
    """
    names = [f"{seconds} s" for seconds in TIMES]
    lines = ["| scene | score | " + " | ".join(names) + " |", "|" + "---|" * (2 + len(names))]
    for scene in dict.fromkeys(row["scene"] for row in rows):
        kinds = ([], [])
        for row in rows:
            if row["scene"] == scene:
                kinds[row["method"] == OPTIMIZED].append(row)
        last = max((row["seconds"] for row in kinds[1]), default=0.0)
        for name, column in COLUMNS.items():
            cells = []
            for seconds in TIMES:
                found = [best_at(kind, seconds, column) for kind in kinds]
                texts = [f"{score:.2f}" if np.isfinite(score) else "-" for score in found]
                cells.append(" / ".join(texts) + (" (ended)" if last < seconds else ""))
            lines.append(f"| {scene} | {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def plot(pyplot: Any, rows: list[Row]) -> Any:
    """A column of panels for each scene, literal above shown; per-scene optimization in black."""
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    methods = list(dict.fromkeys(row["method"] for row in rows))
    color = dict(zip([m for m in methods if m != OPTIMIZED], COLORS, strict=False)) | {OPTIMIZED: "black"}
    figure, panels = pyplot.subplots(
        2, len(scenes), figsize=(1 + 3.4 * len(scenes), 5.6), sharex=True, layout="constrained", squeeze=False
    )
    for column, scene in enumerate(scenes):
        for axes, (name, score) in zip(panels[:, column], COLUMNS.items(), strict=True):
            for method in methods:
                line = [(r["seconds"], r[score]) for r in rows if (r["scene"], r["method"]) == (scene, method)]
                line = [(t, psnr) for t, psnr in line if t > 0.1]
                if line:
                    style = "--" if method == OPTIMIZED else "-"
                    axes.plot(*zip(*line, strict=True), style, marker="o", ms=3, color=color.get(method), label=method)
            axes.set_xscale("log")
            axes.set_ylabel(f"PSNR, {name}, dB")
            axes.spines[["top", "right"]].set_visible(False)
        panels[0, column].set_title(scene)
        _time_ticks(panels[1, column], [row["seconds"] for row in rows])
    figure.legend(
        *panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=min(3, 1 + len(scenes)), fontsize=8
    )
    return figure


def _time_ticks(axes: Any, times: list[float]) -> None:
    """Round ticks of seconds on a logarithmic axis."""
    most = max(times)
    ticks = [tick for tick in (0.1, 0.3, 1, 3, 10, 30, 100, 300, 1000, 3000) if tick <= 1.3 * most]
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    axes.set_xlabel("seconds, without compilation")
