"""Worth of each addition to the paper: quality, time and memory, one field of the configuration at a time.

    ssplat experiment additions --captures path/to/captures --out runs/additions

The additions are the fields in which the preset `tiny` differs from `paper`, the literal one, networks and the size of
the memory aside. They are switched on one after another, from the literal values to those of `tiny`; then each is taken
away from `tiny` alone. The shipped weights are used as they are, so fields that change the shape of a
weight are left at the values of `tiny` and named on the page. Scenes are `procedural:room` and the captures of
`CAPTURES` that are in `--captures`.
"""

import dataclasses
import functools
import itertools
import statistics
from pathlib import Path
from typing import Any

from ssplat_experiments.cases import Case, Row
from ssplat_experiments.memory_curve import START_CAPACITY
from ssplat_experiments.scenes import open_room
from ssplat_experiments.study import Study, at_scale, run_study
from ssplat_experiments.warm_sessions import new_session
from ssplat_jax.config import StreamConfig, preset
from ssplat_jax.core.console import Reporter
from ssplat_jax.core.errors import InputError
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.data.split import Split, interleaved_split
from ssplat_jax.evaluation.cost import measure_latency, peak_memory
from ssplat_jax.evaluation.scoring import score_targets
from ssplat_jax.storage.weights import check_params, load_params
from ssplat_jax.streaming.feed import feed_capture

CAPTURES = {"redkitchen": (5, 128), "fox": (1, 40), "south_building": (1, 112)}
"""Names of real captures, with the stride of their frames and the most context views that they have."""

NUM_TARGETS = 6
STORAGE = ("memory.capacity", "memory.overflow")
"""Fields that say how large the memory is, not what is done."""

EARNED = {"psnr": 0.02, "ssim": 0.002}
"""Smaller differences, in dB and in units of SSIM, count as none."""

KEPT = {
    "additions.unit_features": "it bounds what returns through CGFI chunk after chunk (docs/stability.md)",
    "additions.merged_coverage": "pivots of many members show it, from about 320 x 240 (docs/decisions.md)",
    "stream.scene_scale": "captures come in any unit, and these are in metres or near it",
}
"""Additions of `tiny` that need not earn their place at the size of this experiment, and why."""


@dataclasses.dataclass(frozen=True)
class Sizes:
    """Context views, image size, and how many of the additions are measured (None: all)."""

    context: int
    size: tuple[int, int]
    additions: int | None = None


SIZES = {"smoke": Sizes(8, (64, 48), 1), "cpu": Sizes(64, (160, 120)), "gpu": Sizes(128, (320, 240))}


@dataclasses.dataclass(frozen=True)
class Addition:
    """A field with its literal value and that of `tiny`."""

    field: str
    literal: Any
    ours: Any


def run(captures: Path | None, out: Path, scale: str, reporter: Reporter) -> str:
    """Measures every addition on every available scene."""
    for addition in unmeasured():
        reporter.warn(f"additions: {addition.field} stays {addition.ours!r}; {addition.literal!r} needs other weights")
    return run_study(STUDY, captures, out, scale, reporter)


def differing_fields() -> list[Addition]:
    """All fields in which `tiny` differs from the literal preset, networks and the size of the memory aside."""
    literal, ours = preset("paper"), preset("tiny")
    groups = [group for group in ours.groups() if group != "network"]
    names = [f"{group}.{field.name}" for group in groups for field in dataclasses.fields(getattr(ours, group))]
    found = [Addition(name, literal.get(name), ours.get(name)) for name in names if name not in STORAGE]
    # A causal stream keeps the order of frames whatever chunk_step is, so its effect shows only after this field.
    found.sort(key=lambda addition: addition.field != "stream.causal")
    return [addition for addition in found if addition.literal != addition.ours]


@functools.cache
def additions() -> list[Addition]:
    """The additions that the shipped weights can do without."""
    shipped = load_params("tiny")
    return [addition for addition in differing_fields() if _fits(addition, shipped)]


def unmeasured() -> list[Addition]:
    """The fields that need weights of other shapes, or that no configuration of `tiny` can take back."""
    return [addition for addition in differing_fields() if addition not in additions()]


def _fits(addition: Addition, shipped: dict) -> bool:
    try:
        check_params(shipped, preset("tiny").replace(**{addition.field: addition.literal}), "tiny")
    except InputError:
        return False
    return True


def variants(found: list[Addition]) -> list[tuple[str, str, StreamConfig]]:
    """(path, step, configuration): from the literal fields to `tiny`, then `tiny` without each.

    Args:
        found: the additions, in the order in which they are switched on.

    Returns:
        The literal configuration first; each following one of the path `added` differs by one field from the one
        before, and each of the path `taken away` by one field from `tiny`.
    """
    ours = preset("tiny").replace(capacity=START_CAPACITY)
    steps = [("added", "literal", ours.replace(**{a.field: a.literal for a in found}))]
    for a in found:
        steps.append(("added", f"{a.field}={a.ours}", steps[-1][2].replace(**{a.field: a.ours})))
    return steps + [("taken away", f"{a.field}={a.literal}", ours.replace(**{a.field: a.literal})) for a in found]


def cases(captures: Path | None, scale: str) -> list[Case]:
    """A case for each variant and scene."""
    sizes = at_scale(SIZES, scale)
    scenes = ["room", *(name for name in CAPTURES if captures is not None and (captures / name).is_dir())]
    return [
        Case(
            name=f"{scene}, {path} {step}",
            config=config,
            asked={"scene": scene, "path": path, "step": step, "context": sizes.context, "size": sizes.size},
            measure=functools.partial(measured, scene, path, step, config, sizes, captures),
        )
        for path, step, config in variants(additions()[: sizes.additions])  # outermost: scenes share their programs
        for scene in scenes
    ]


@functools.lru_cache(maxsize=4)
def _open(scene: str, sizes: Sizes, captures: Path | None) -> tuple[Capture, Split]:
    if scene == "room" or captures is None:
        return open_room(sizes.context, sizes.size)
    capture = open_capture(captures / scene, size=sizes.size)
    stride, most = CAPTURES[scene]
    return capture, interleaved_split(len(capture), stride, min(sizes.context, most))


def measured(scene: str, path: str, step: str, config: StreamConfig, sizes: Sizes, captures: Path | None) -> list[Row]:
    """Scores, time and memory of a configuration on a scene."""
    capture, split = _open(scene, sizes, captures)
    frame = capture.stream_frame(config, split.context)
    session = new_session(config)
    exposures, recent = feed_capture(session, capture, split.context, frame, num_recent=1)
    targets = split.targets[:NUM_TARGETS]
    scores = score_targets(session.gaussians(), capture, targets, frame, exposures)
    camera = capture.camera(targets[len(targets) // 2], frame)
    memory = peak_memory(session, camera)
    return [
        {
            "scene": scene,
            "path": path,
            "step": step,
            "literal_psnr": scores["literal"]["psnr"],
            "shown_psnr": scores["shown"]["psnr"],
            "literal_ssim": scores["literal"]["ssim"],
            "shown_ssim": scores["shown"]["ssim"],
            "chunk_ms": measure_latency(session, recent, camera)["chunk_ms"]["median"],
            "peak_memory_bytes": memory.bytes,
            "gaussians": session.cache_facts()["decoded"],
        }
    ]


def add_gains(rows: list[Row]) -> None:
    """Gain of each addition: its row minus the one before, or all of `tiny` minus the row without it.

    Scene by scene, in the order in which they were first measured.
    """
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    rows.sort(key=lambda row: scenes.index(row["scene"]))
    for scene in scenes:
        path = [row for row in rows if (row["scene"], row["path"]) == (scene, "added")]
        for before, after in itertools.pairwise(path):
            _set_gains(after, before, after)
        for row in rows:
            if (row["scene"], row["path"]) == (scene, "taken away") and path:
                _set_gains(row, row, path[-1])


def _set_gains(row: Row, without: Row, with_it: Row) -> None:
    for column in ("literal", "shown"):
        row[f"{column}_gain_db"] = round(with_it[f"{column}_psnr"] - without[f"{column}_psnr"], 3)
        row[f"{column}_gain_ssim"] = round(with_it[f"{column}_ssim"] - without[f"{column}_ssim"], 4)
    row["added_ms"] = round(with_it["chunk_ms"] - without["chunk_ms"], 1)
    if with_it["peak_memory_bytes"] is not None and without["peak_memory_bytes"] is not None:
        row["added_bytes"] = with_it["peak_memory_bytes"] - without["peak_memory_bytes"]


def findings(rows: list[Row]) -> list[str]:
    """Additions that earn their place, by what their absence from `tiny` costs on the mean of the scenes."""
    lines = []
    for step in dict.fromkeys(row["step"] for row in rows if row["path"] == "taken away"):
        gains = [row for row in rows if (row["path"], row["step"]) == ("taken away", step) and "shown_gain_db" in row]
        if not gains:
            continue
        means = {
            (c, metric): statistics.mean(row[f"{c}_gain_{unit}"] for row in gains)
            for c in ("literal", "shown")
            for metric, unit in (("psnr", "db"), ("ssim", "ssim"))
        }
        values = ", ".join(
            f"{means[c, 'psnr']:+.2f} dB and {means[c, 'ssim']:+.4f} SSIM {c}" for c in ("literal", "shown")
        )
        earned = [f"{metric.upper()} {c}" for (c, metric), gain in means.items() if gain >= EARNED[metric]]
        kept = KEPT.get(step.partition("=")[0], "no reason is known")
        verdict = f"earned in {', '.join(earned)}" if earned else f"not earned here; kept: {kept}"
        lines.append(f"* against {step}: {values} on {len(gains)} scenes; {verdict}.")
    left_out = ", ".join(f"{a.field}={a.literal}" for a in unmeasured())
    return (
        ["\n".join([*lines, f"* Not measured, other weights needed: {left_out}."])] if left_out else ["\n".join(lines)]
    )


STUDY = Study(
    name="additions",
    text="""Rows `added` start with the literal fields and switch one addition on after another, up to `tiny`; rows
`taken away` are `tiny` with one field at its literal value. Gains are what the addition gives: dB of PSNR, ms a chunk
and MiB of peak memory, with the shipped weights and no retraining.""",
    cases=cases,
    finish=add_gains,
    findings=findings,
)
