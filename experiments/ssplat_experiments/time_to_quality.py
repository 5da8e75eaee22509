"""Quality of unseen views against seconds: the stream, the stream refined, and per-scene optimization.

    ssplat experiment time_to_quality --captures path/to/captures --out runs/time_to_quality

All methods learn from the same views, render with the same rasterizer, and are scored on the same views that none has
seen, on the same machine. Time is that of the work: compilation, scoring, the depth range of the capture and the sparse
points that per-scene optimization starts from are not in it. Needs an idle machine.

* `stream`: the scene after each chunk.
* `stream + offline N`: then N steps of refinement on the streamed views (`ssplat refine --steps N`).
* `stream + online M`: refinement after each chunk (`--online-refine M`).
* `per-scene optimization`: 3D Gaussian Splatting from sparse points (`per_scene_optimization.py`), with the exposures
  of the views that the stream estimated, until three scores in a row are no better than the best before them.
"""

import dataclasses
import functools
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ssplat_experiments.cases import WITH_REFINER, Case, Row
from ssplat_experiments.memory_curve import START_CAPACITY
from ssplat_experiments.per_scene_optimization import optimize
from ssplat_experiments.scene_state import scene_of
from ssplat_experiments.scenes import open_room
from ssplat_experiments.sparse_points import gaussians_of_points, sparse_points
from ssplat_experiments.stopwatch import Stopwatch
from ssplat_experiments.study import Study, at_scale, run_study
from ssplat_experiments.time_curves import OPTIMIZED, findings, plot
from ssplat_experiments.warm_sessions import new_session
from ssplat_jax.config import StreamConfig, preset
from ssplat_jax.core.console import Reporter
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.data.split import Split, interleaved_split
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.evaluation.scoring import score_targets
from ssplat_jax.refinement.refine import continue_refinement, key_views_of, start_refinement
from ssplat_jax.refinement.refine_config import FOR_CAPTURES
from ssplat_jax.streaming.feed import Exposures, feed_chunks

CAPTURES = {"fox": 1, "redkitchen": 5}
"""Names of real captures, with the stride of their frames."""

STREAM, OFFLINE, ONLINE = "stream", "stream + offline {}", "stream + online {}"

PATIENCE = 3
"""Number of scores in a row after which a method ends, if none is better than all before them, in any column."""

GROWTH = 1.4
"""Factor between the times of two scores of per-scene optimization."""


@dataclasses.dataclass(frozen=True)
class Sizes:
    """Views, image size and length of the curves."""

    context: int
    size: tuple[int, int]
    """(width, height) of a landscape image; portrait captures have them swapped."""
    targets: int
    seconds: float
    """Most seconds of per-scene optimization."""
    steps: tuple[int, ...]
    """Planned steps of offline refinement, a curve each."""
    online: tuple[int, ...]
    """Values of --online-refine, a curve each."""


SIZES = {
    "smoke": Sizes(8, (64, 48), 2, 2.0, (10,), (1,)),
    "cpu": Sizes(32, (160, 120), 6, 600.0, (200, 800), (5,)),
    "gpu": Sizes(64, (320, 240), 9, 600.0, (400,), (2, 4, 8)),
}


def run(captures: Path | None, out: Path, scale: str, reporter: Reporter) -> str:
    """Measures every method on every available scene."""
    return run_study(STUDY, captures, out, scale, reporter)


def cases(captures: Path | None, scale: str) -> list[Case]:
    """A case for each method and scene; the methods are outermost, since scenes share their programs."""
    sizes = at_scale(SIZES, scale)
    scenes = ["room", *(name for name in CAPTURES if captures is not None and (captures / name).is_dir())]
    config = preset("tiny").replace(capacity=START_CAPACITY)
    methods = {STREAM: (config, 0)}
    methods |= {ONLINE.format(steps): (config.replace(steps_per_chunk=steps), 0) for steps in sizes.online}
    methods |= {OFFLINE.format(steps): (config, steps) for steps in sizes.steps}
    methods[OPTIMIZED] = config, 0
    return [
        Case(
            name=f"{scene}, {method}",
            config=config,
            asked={"scene": scene, "method": method, **dataclasses.asdict(sizes)},
            measure=functools.partial(measured, scene, method, config, offline, sizes, captures),
            weights=WITH_REFINER,
        )
        for method, (config, offline) in methods.items()
        for scene in scenes
    ]


@dataclasses.dataclass(frozen=True)
class _Scene:
    """A capture, opened, with its split and its frame."""

    name: str
    capture: Capture
    split: Split
    frame: StreamFrame


@functools.lru_cache(maxsize=4)
def _open(name: str, sizes: Sizes, captures: Path | None) -> _Scene:
    if name == "room" or captures is None:
        capture, split = open_room(sizes.context, sizes.size)
    else:
        own, (long, short) = open_capture(captures / name), sizes.size
        capture = open_capture(captures / name, size=(long, short) if own.width >= own.height else (short, long))
        split = interleaved_split(len(capture), CAPTURES[name], sizes.context)
    targets = np.linspace(0, len(split.targets) - 1, min(sizes.targets, len(split.targets)))
    split = dataclasses.replace(split, targets=tuple(split.targets[i] for i in sorted({round(t) for t in targets})))
    return _Scene(name, capture, split, capture.stream_frame(preset("tiny"), split.context))


def measured(
    name: str, method: str, config: StreamConfig, offline: int, sizes: Sizes, captures: Path | None
) -> list[Row]:
    """The curve of a method on a scene; `offline` steps follow the stream."""
    scene, curve = _open(name, sizes, captures), Curve(name, method)
    is_shown = not offline and method != OPTIMIZED
    exposures, gaussians = stream(scene, config, curve, is_shown=is_shown)
    if offline:
        refine_offline(scene, gaussians, exposures, offline, curve)
    if method == OPTIMIZED:
        curve = Curve(name, method)  # the stream lent its exposures, and its time does not count
        optimize_scene(scene, exposures, sizes, curve)
    return curve.rows


class Curve:
    """Scores of one method against the seconds of its work."""

    def __init__(self, scene: str, method: str) -> None:
        self.watch, self.rows, self._place = Stopwatch(), [], {"scene": scene, "method": method}

    def add(self, scene: _Scene, gaussians: Gaussians, exposures: Exposures, **facts: Any) -> None:
        """Scores the targets at the time that the watch shows.

        A scene that learned over black makes up for what shines through: filled holes make it too bright. Its `shown`
        score is the better one of filled and black holes, and has no SSIM.
        """
        scores = score_targets(gaussians, scene.capture, scene.split.targets, scene.frame, exposures)
        columns = {f"{c}_{m}": round(scores[c][m], 4) for c in ("literal", "shown") for m in ("psnr", "ssim")}
        if self._place["method"] == OPTIMIZED:
            columns["shown_psnr"] = round(max(scores["shown"]["psnr"], scores["psnr_over_black"]), 4)
            del columns["shown_ssim"]
        self.rows.append(
            {
                **self._place,
                "seconds": round(self.watch.seconds, 3),
                **columns,
                "gaussians": int(np.sum(np.asarray(gaussians.opacities) > 0)),
                **facts,
            }
        )

    @property
    def has_ended(self) -> bool:
        """True if none of the last `PATIENCE` scores is better than all scores before them, in any column."""
        return all(
            max((row[column] for row in self.rows[-PATIENCE:]), default=0.0)
            <= max((row[column] for row in self.rows[:-PATIENCE]), default=-np.inf)
            for column in ("literal_psnr", "shown_psnr")
        )


def stream(scene: _Scene, config: StreamConfig, curve: Curve, *, is_shown: bool) -> tuple[Exposures, Gaussians]:
    """Streams the context; with `is_shown`, the curve has a point whenever the number of views has doubled."""
    session, exposures, wanted = new_session(config), {}, config.stream.chunk_size
    order = scene.capture.stream_order(config, scene.split.context, scene.frame)
    for fed in curve.watch.over(feed_chunks(session, scene.capture, order, scene.frame)):
        exposures |= fed.exposures
        if is_shown and (len(exposures) >= wanted or len(exposures) == len(order)):
            wanted = 2 * len(exposures)
            curve.add(scene, _decoded(session, curve), exposures, views=len(exposures))
    return exposures, _decoded(session, curve)


def _decoded(session, curve: Curve) -> Gaussians:
    with curve.watch.running():
        return jax.block_until_ready(session.gaussians())


def refine_offline(scene: _Scene, gaussians: Gaussians, exposures: Exposures, planned: int, curve: Curve) -> None:
    """Refinement on the streamed views; a point when the number of steps has doubled, and at the end."""
    curve.add(scene, gaussians, exposures, steps=0)
    with curve.watch.running():
        given = key_views_of(scene.capture, scene.split.context, scene.frame, exposures)
        progress, views = start_refinement(gaussians, given, FOR_CAPTURES)
    due, scored = 1, 0

    def score() -> None:
        with curve.watch.running():
            refined = jax.block_until_ready(progress.scene(gaussians))
        curve.add(scene, refined, exposures, steps=progress.num_steps)

    for _ in curve.watch.over(continue_refinement(progress, views, planned, FOR_CAPTURES)):
        if progress.num_steps >= due:
            due, scored = 2 * progress.num_steps, progress.num_steps
            score()
    if scored < progress.num_steps:  # it may end before the planned steps
        score()


def optimize_scene(scene: _Scene, exposures: Exposures, sizes: Sizes, curve: Curve) -> None:
    """Per-scene optimization from sparse points, scored at times that grow by `GROWTH`."""
    points, origin = sparse_points(scene.capture, scene.split.context, scene.frame)
    with curve.watch.running():
        start = gaussians_of_points(points)
        views = key_views_of(scene.capture, scene.split.context, scene.frame, exposures)
    curve.add(scene, start, exposures, steps=0, start=f"{len(points[0])} {origin} points")
    due = (0.5 * GROWTH**k for k in itertools.count())
    next_due = next(due)
    for steps, state in enumerate(curve.watch.over(optimize(start, views)), start=1):
        is_over = curve.watch.seconds >= sizes.seconds
        if curve.watch.seconds >= next_due or is_over:
            next_due = next(t for t in due if t > curve.watch.seconds)
            curve.add(scene, scene_of(state.parameters, state.is_present), exposures, steps=steps)
            if is_over or curve.has_ended:
                return


def _finish(rows: list[Row]) -> None:
    """Sorts the rows by scene, the curves of a scene together."""
    scenes: Sequence[str] = list(dict.fromkeys(row["scene"] for row in rows))
    rows.sort(key=lambda row: scenes.index(row["scene"]))


STUDY = Study(
    name="time_to_quality",
    text="""All methods see the same context views and are scored on the same views that none has seen. Seconds are
wall time of the work on this machine: without compilation, without scoring, without the depth range of the capture and
without the sparse points. Per-scene optimization starts from points triangulated between the context views (random ones
where there are too few), has the published rates and densification of 3D Gaussian Splatting, learns at the exposures
that the stream estimated, and ends when three scores in a row are no better than the best before them. `literal`: over
black, at the exposure of the scene; `shown`: holes filled and the exposure of the nearest views. Per-scene optimization
learns over black, where filled holes are too bright: its `shown` is the better one of filled and black holes.""",
    cases=cases,
    finish=_finish,
    plot=plot,
    findings=findings,
)
