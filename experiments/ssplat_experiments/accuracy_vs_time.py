"""Accuracy against time: PSNR of unseen views and milliseconds per view of many settings.

    ssplat experiment accuracy_vs_time --captures path/to/captures --out runs/accuracy_vs_time

Every setting streams the same context views of `procedural:room` (and of redkitchen, where `--captures` has it) with
the shipped weights, no retraining, and is scored on the same targets at the same size, whatever size it streamed at.
Time is chunk in -> one novel view out on the full cache, warm. Writes `table.json`, `table.csv`, `page.md` and
`plot.png`; what `--out` holds is not measured again. A `table.json` of an earlier version that stands there as
`earlier.json` is drawn too. Needs an idle machine.
"""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ssplat_experiments.cases import Case, Row
from ssplat_experiments.settings import (
    REFINED,
    REFINED_FACTORS,
    SETTINGS,
    SIZES,
    Opened,
    Setting,
    Sizes,
    config_of,
    measure,
    measure_refined,
)
from ssplat_experiments.streams import REDKITCHEN, open_redkitchen, open_room
from ssplat_experiments.study import Study, at_scale, run_study
from ssplat_jax.core.console import Reporter
from ssplat_jax.data.parsing import load_json


def run(captures: Path | None, out: Path, scale: str, reporter: Reporter) -> str:
    """Measures every setting on every available scene; `smoke` takes one."""
    if captures is None or not (captures / REDKITCHEN).is_dir():
        reporter.warn("no redkitchen under --captures: the procedural scene stands alone")
    path = out / "earlier.json"
    earlier = load_json(path, list) if path.exists() else []
    study = dataclasses.replace(STUDY, plot=functools.partial(plot, earlier=earlier))
    return run_study(study, captures, out, scale, reporter)


def cases(captures: Path | None, scale: str) -> list[Case]:
    """A case for every setting and scene, then one for every size and scene whose stream is refined."""
    sizes = at_scale(SIZES, scale)
    groups = [[setting] for setting in SETTINGS[: sizes.settings]]
    if sizes.settings is None:
        groups += [[setting for setting in REFINED if setting.factor == factor] for factor in REFINED_FACTORS]
    asked = {**dataclasses.asdict(sizes), "settings": None}
    return [
        Case(
            name=f"{scene}, {group[-1].name}",
            config=config_of(group[0], sizes),
            asked={"scene": scene, "factor": group[0].factor, "steps": [s.refine_steps for s in group], **asked},
            measure=functools.partial(_measured, scene, group, sizes, opened),
        )
        for group in groups
        for scene, opened in _scenes(captures, sizes.context).items()
    ]


def _measured(scene: str, settings: list[Setting], sizes: Sizes, opened: Opened) -> list[Row]:
    first = settings[0]
    rows = measure_refined(settings, sizes, opened) if first.refine_steps else [measure(first, sizes, opened)]
    return [{"scene": scene} | row for row in rows]


def _scenes(captures: Path | None, context: int) -> dict[str, Opened]:
    """The available scenes by name."""
    scenes: dict[str, Opened] = {"room": functools.partial(open_room, context)}
    if captures is not None and (captures / REDKITCHEN).is_dir():
        scenes[REDKITCHEN] = functools.partial(open_redkitchen, captures, context)
    return scenes


def mark_fronts(rows: list[Row]) -> None:
    """Sorts by time, and sets `front` on every row: no other one of its scene is both faster and at least as good."""
    best: dict[str, float] = {}
    rows.sort(key=lambda row: (row["scene"], row["ms_per_view"], -row["shown"]))
    for row in rows:
        row["front"] = bool(row["shown"] > best.get(row["scene"], -np.inf))
        best[row["scene"]] = max(best.get(row["scene"], -np.inf), row["shown"])


def plot(pyplot: Any, rows: list[Row], earlier: Sequence[Row] = ()) -> Any:
    """A panel a scene: the front as a line, qualities named, refined scenes as triangles, an earlier version gray."""
    quality = {setting.name: setting.quality for setting in (*SETTINGS, *REFINED) if setting.quality}
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    figure, panels = pyplot.subplots(1, len(scenes), figsize=(7 * len(scenes), 5), layout="constrained", squeeze=False)
    for axes, scene in zip(panels[0], scenes, strict=True):
        here = sorted((row for row in rows if row["scene"] == scene), key=lambda row: row["ms_per_view"])
        front = [row for row in here if row["front"]]
        axes.plot([r["ms_per_view"] for r in front], [r["shown"] for r in front], color="#c06030", lw=1.2, zorder=1)
        for row in here:
            at, name = (row["ms_per_view"], row["shown"]), quality.get(row["setting"])
            axes.scatter(*at, s=60 if name else 22, marker="^" if "refine_s" in row else "o", color="#30507a", zorder=2)
            if name:
                axes.annotate(name, at, textcoords="offset points", xytext=(6, -10), fontsize=9, weight="bold")
        for row in (row for row in earlier if row["scene"] == scene):
            at, marker = (row["ms_per_view"], row["shown"]), "^" if "refine_s" in row else "o"
            axes.scatter(*at, s=60, marker=marker, color="#909090", zorder=2)
            axes.annotate(row["commit"], at, textcoords="offset points", xytext=(6, -10), fontsize=8, color="#606060")
        axes.set_xscale("log")
        axes.set_xlabel("ms per view, chunk in to novel view out, refinement spread over the views")
        axes.set_title(scene)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0, 0].set_ylabel("PSNR of unseen views as shown, dB")
    return figure


STUDY = Study(
    name="accuracy_vs_time",
    text="""Every setting streams the same context views with the shipped weights and is scored on the same views at the
same size. Time is chunk in, one novel view out, on the full cache. `front`: no other setting of the scene is both
faster and at least as good. Rows with steps are the second axis: refinement steps on the streamed views after the
stream, their time (`refine s`, without compilation) spread over the views. One front holds all of them.""",
    cases=cases,
    finish=mark_fronts,
    plot=plot,
)
