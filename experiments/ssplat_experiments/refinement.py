"""Refinement on whole captures: after the stream, while streaming, and with poses that are wrong.

    ssplat experiment refinement --captures path/to/captures --out runs/refinement

Every scene streams its context views with the shipped weights and is scored on the same views that were never shown.

* `stream`: the scene after the stream.
* `offline`: then 100 steps on the streamed views, as `ssplat eval --refine 100` takes them: learned passes first.
* `learned passes`: the same, stopped after its learned passes; `gradient steps`: 100 steps without learned passes.
* `online`: refinement after each chunk, as `--online-refine` asks for it.
* `wrong poses, ...`: all context cameras but the first are turned by 0.5 degrees and moved by 1 % of the depth, each
  in a direction of its own. Targets keep their poses. `poses adjusted`: the context's poses are adjusted to its images
  before the stream, as `--revise poses` does. `targets carried`: the same scene; each target is moved as adjustment
  moved the two context views beside it from their exact poses.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ssplat_experiments.captures import SETTINGS
from ssplat_experiments.cases import WITH_REFINER, Case, Row
from ssplat_experiments.memory_curve import START_CAPACITY
from ssplat_experiments.scenes import open_room
from ssplat_experiments.stopwatch import Stopwatch
from ssplat_experiments.study import Study, at_scale, run_study
from ssplat_experiments.warm_sessions import new_session
from ssplat_jax.config import MEDIAN_DEPTH, StreamConfig, preset
from ssplat_jax.core.console import Reporter
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.data.posed_image import invert_pose
from ssplat_jax.data.split import Split, interleaved_split
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.evaluation.psnr_ssim import psnr
from ssplat_jax.evaluation.scoring import mean_scores, score_view
from ssplat_jax.poses.adjust_poses import adjust_poses
from ssplat_jax.refinement.learned_pass import STEPS as STEPS_OF_PASS
from ssplat_jax.refinement.refine import refine_on_capture
from ssplat_jax.refinement.refine_config import FOR_CAPTURES, RefineConfig
from ssplat_jax.streaming.feed import Exposures, feed_chunks

TURN_DEGREES, SHIFT_OF_DEPTH = 0.5, 0.01
"""Errors of the poses: the angle of a rotation, and the length of a shift as a fraction of the median depth."""

STREAM, OFFLINE, ONLINE = "stream", "offline", "online"
PASSES, GRADIENT = "learned passes", "gradient steps"
WRONG, WRONG_OFFLINE = "wrong poses, stream", "wrong poses, offline"
ADJUSTED, ADJUSTED_OFFLINE, CARRIED = "poses adjusted, stream", "poses adjusted, offline", "targets carried, offline"


@dataclasses.dataclass(frozen=True)
class Sizes:
    """Views, image size and gradient steps of a scale."""

    context: int | None
    """Context views; None: as `captures.SETTINGS` says."""
    size: tuple[int, int] | None
    """(width, height); None: as `captures.SETTINGS` says."""
    steps: int
    """Steps after the stream, those in the place of learned passes included."""
    per_chunk: int
    """Gradient steps after each chunk."""


SIZES = {"smoke": Sizes(8, (64, 48), 2, 1), "cpu": Sizes(None, None, 100, 5)}


@dataclasses.dataclass(frozen=True)
class _Scene:
    capture: Capture
    split: Split
    frame: StreamFrame


@dataclasses.dataclass(frozen=True)
class _Streamed:
    gaussians: Gaussians
    exposures: Exposures
    chunk_s: float  # median of a chunk, its online refinement included


def run(captures: Path | None, out: Path, scale: str, reporter: Reporter) -> str:
    """Measures the room and the captures that are there; `smoke` takes the room alone."""
    return run_study(STUDY, captures, out, scale, reporter)


def cases(captures: Path | None, scale: str) -> list[Case]:
    """Three cases for each scene."""
    sizes = at_scale(SIZES, scale)
    config = preset("tiny").replace(**({"capacity": START_CAPACITY} if sizes.size else {}))
    kinds: dict[str, tuple[StreamConfig, Callable[..., list[Row]]]] = {
        OFFLINE: (config, measure_offline),
        ONLINE: (config.replace(steps_per_chunk=sizes.per_chunk), measure_online),
        WRONG: (config, measure_wrong_poses),
    }
    return [
        Case(
            name=f"{scene}, {kind}",
            config=of_kind,
            asked={"scene": scene, "kind": kind, **dataclasses.asdict(sizes)},
            measure=functools.partial(measure, scene, open_scene, of_kind, sizes),
            weights=WITH_REFINER,
        )
        for scene, open_scene in _scenes(captures, sizes).items()
        for kind, (of_kind, measure) in kinds.items()
    ]


def _scenes(captures: Path | None, sizes: Sizes) -> dict[str, Callable[[], _Scene]]:
    """The available scenes by name, each not opened yet."""
    scenes = {"room": functools.partial(_open_room, sizes)}
    for name, stride, context, size in SETTINGS if sizes.size is None else ():
        if captures is not None and (captures / name).is_dir():
            scenes[f"{name} {stride}"] = functools.partial(_open, captures / name, stride, context, size)
    return scenes


def _open_room(sizes: Sizes) -> _Scene:
    return _with_frame(*open_room(sizes.context or 64, sizes.size or (320, 240)))


def _open(path: Path, stride: int, context: int, size: tuple[int, int] | None) -> _Scene:
    capture = open_capture(path, size=size)
    return _with_frame(capture, interleaved_split(len(capture), stride, context))


def _with_frame(capture: Capture, split: Split) -> _Scene:
    return _Scene(capture, split, capture.stream_frame(preset("tiny"), split.context))


def measure_offline(name: str, open_scene: Callable[[], _Scene], config: StreamConfig, sizes: Sizes) -> list[Row]:
    """The scene after the stream, and after the steps that follow it, with learned passes, those alone, and without."""
    scene = open_scene()
    streamed = _stream(scene, scene.capture, config)
    rows = [_row(name, STREAM, scene, streamed.gaussians, streamed.exposures) | {"chunk_s": streamed.chunk_s}]
    passes = min(sizes.steps, FOR_CAPTURES.learned_passes * STEPS_OF_PASS)
    alone = dataclasses.replace(FOR_CAPTURES, learned_passes=0)
    for method, steps, refine in (
        (PASSES, passes, FOR_CAPTURES),
        (GRADIENT, sizes.steps, alone),
        (OFFLINE, sizes.steps, FOR_CAPTURES),
    ):
        rows.append(_row_of_refined(name, method, scene, _refined(scene, scene.capture, streamed, steps, refine)))
    return rows


def measure_online(name: str, open_scene: Callable[[], _Scene], config: StreamConfig, sizes: Sizes) -> list[Row]:
    """The scene after a stream that was refined chunk by chunk; times are compared with a stream right before it."""
    scene = open_scene()
    unrefined_s = _stream(scene, scene.capture, config.replace(steps_per_chunk=0)).chunk_s
    streamed = _stream(scene, scene.capture, config)
    row = _row(name, ONLINE, scene, streamed.gaussians, streamed.exposures)
    times = {"chunk_s": streamed.chunk_s, "chunk_ratio": round(streamed.chunk_s / unrefined_s, 2)}
    return [row | {"steps": sizes.per_chunk} | times]


def measure_wrong_poses(name: str, open_scene: Callable[[], _Scene], config: StreamConfig, sizes: Sizes) -> list[Row]:
    """The scene of wrong poses, after the stream and refined; and that of poses that were adjusted."""
    scene = open_scene()
    depth = MEDIAN_DEPTH / scene.frame.scale
    wrong = with_wrong_poses(scene.capture, scene.split.context, depth)
    streamed = _stream(scene, wrong, config)
    rows = [
        _row(name, WRONG, scene, streamed.gaussians, streamed.exposures),
        _row_of_refined(name, WRONG_OFFLINE, scene, _refined(scene, wrong, streamed, sizes.steps)),
    ]
    del streamed
    adjusted = adjust_poses(wrong, scene.split.context).capture
    streamed = _stream(scene, adjusted, config)
    refined = _refined(scene, adjusted, streamed, sizes.steps)
    carried = dataclasses.replace(scene, capture=with_carried_targets(scene.capture, adjusted, scene.split))
    return [
        *rows,
        _row(name, ADJUSTED, scene, streamed.gaussians, streamed.exposures),
        _row_of_refined(name, ADJUSTED_OFFLINE, scene, refined),
        _row_of_refined(name, CARRIED, carried, refined),
    ]


def with_wrong_poses(capture: Capture, indices: Sequence[int], depth: float, seed: int = 0) -> Capture:
    """The capture with errors in the poses of the frames `indices` but the first: `TURN_DEGREES`, `SHIFT_OF_DEPTH`.

    Args:
        capture: the exact poses.
        indices: frames whose poses get errors.
        depth: median depth of the scene, in units of the capture.
        seed: seed of the directions.
    """
    rng, frames = np.random.default_rng(seed), list(capture.frames)
    for i in indices[1:]:
        turn, shift = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
        pose = frames[i].camtoworld.copy()
        pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(np.radians(TURN_DEGREES) * turn).as_matrix()
        pose[:3, 3] += SHIFT_OF_DEPTH * depth * shift
        frames[i] = dataclasses.replace(frames[i], camtoworld=pose)
    return dataclasses.replace(capture, frames=tuple(frames))


def with_carried_targets(exact: Capture, moved: Capture, split: Split) -> Capture:
    """The exact capture with each target moved as its two nearest context frames are moved in `moved`, on average.

    Adjusted poses agree with each other, and drift together by what images do not tell. A target at its exact pose is
    then beside the scene by that drift, whatever the scene is like.
    """
    frames = list(exact.frames)
    for i in split.targets:
        near = sorted(split.context, key=lambda j: abs(j - i))[:2]
        motions = [moved.frames[j].camtoworld @ invert_pose(exact.frames[j].camtoworld) for j in near]
        pose = exact.frames[i].camtoworld
        turn = Rotation.from_matrix(np.stack([motion[:3, :3] for motion in motions])).mean().as_matrix()
        carried = np.eye(4)
        carried[:3, :3] = turn @ pose[:3, :3]
        carried[:3, 3] = np.mean([motion[:3, :3] @ pose[:3, 3] + motion[:3, 3] for motion in motions], axis=0)
        frames[i] = dataclasses.replace(frames[i], camtoworld=carried)
    return dataclasses.replace(exact, frames=tuple(frames))


def _stream(scene: _Scene, capture: Capture, config: StreamConfig) -> _Streamed:
    session, exposures, seconds = new_session(config), {}, []
    order = capture.stream_order(config, scene.split.context, scene.frame)
    for fed in feed_chunks(session, capture, order, scene.frame):
        exposures |= fed.exposures
        seconds.append(fed.seconds)
    return _Streamed(session.gaussians(), exposures, round(float(np.median(seconds)), 3))


@dataclasses.dataclass(frozen=True)
class _Refined:
    gaussians: Gaussians
    exposures: Exposures
    steps: int
    seconds: float


def _refined(
    scene: _Scene, capture: Capture, streamed: _Streamed, steps: int, config: RefineConfig = FOR_CAPTURES
) -> _Refined:
    """The scene after steps on the context views as `capture` has them."""
    watch, given = Stopwatch(), (capture, scene.split.context, scene.frame, streamed.exposures)
    with watch.running():
        refined, report = refine_on_capture(streamed.gaussians, *given, steps=steps, config=config)
        jax.block_until_ready(refined.means)
    return _Refined(refined, streamed.exposures, report.num_steps, watch.seconds)


def _row_of_refined(name: str, method: str, scene: _Scene, refined: _Refined) -> Row:
    taken = {"steps": refined.steps, "refine_s": round(refined.seconds, 1)}
    return _row(name, method, scene, refined.gaussians, refined.exposures) | taken


def _row(name: str, method: str, scene: _Scene, gaussians: Gaussians, exposures: Exposures) -> dict[str, Any]:
    views = [score_view(gaussians, scene.capture, i, scene.frame, exposures) for i in scene.split.targets]
    scores = mean_scores([view.score for view in views])
    row: dict[str, Any] = {"scene": name, "method": method, "steps": 0}
    for column in ("literal", "shown"):
        row |= {f"{column}_{metric}": round(scores[column][metric], 4) for metric in ("psnr", "ssim")}
    row["over_black_psnr"] = scores["psnr_over_black"]
    row["own_gain_psnr"] = round(float(np.mean([own_gain_psnr(view.color, view.target) for view in views])), 4)
    return row


def own_gain_psnr(color: Float[np.ndarray, "h w 3"], target: Float[np.ndarray, "h w 3"]) -> float:
    """PSNR in dB after one factor for each channel, by least squares against the target itself.

    No score of a method, since it looks at the target: it says what the exposure of the nearest views costs.
    """
    gain = np.sum(color * target, axis=(0, 1)) / np.maximum(np.sum(color * color, axis=(0, 1)), 1e-12)
    return psnr(np.clip(color * gain, 0.0, 1.0).astype(np.float32), target)


def findings(rows: list[Row]) -> list[str]:
    """Sentences: gains of refinement on each scene, and losses by wrong poses with and without their revision."""
    sentences = []
    for scene in dict.fromkeys(row["scene"] for row in rows):
        by = {row["method"]: row for row in rows if row["scene"] == scene}
        if STREAM not in by:
            continue
        for method in (PASSES, GRADIENT, OFFLINE, ONLINE):
            if method in by:
                gains = [by[method][c] - by[STREAM][c] for c in ("shown_psnr", "literal_psnr")]
                sentences.append(f"{scene}: {method} {gains[0]:+.2f} dB shown, {gains[1]:+.2f} dB literal.")
        if ONLINE in by:
            ratio = by[ONLINE]["chunk_ratio"]
            sentences.append(f"{scene}: a chunk takes {ratio:.2f} times as long with online refinement.")
        if CARRIED in by:
            methods = WRONG_OFFLINE, ADJUSTED_OFFLINE, CARRIED
            lost, adjusted, carried = (by[OFFLINE]["shown_psnr"] - by[m]["shown_psnr"] for m in methods)
            sentences.append(
                f"{scene}: wrong poses lose {lost:.2f} dB shown; with poses adjusted {adjusted:.2f} dB are lost, and"
                f" {carried:.2f} dB at carried targets."
            )
    return sentences


STUDY = Study(
    name="refinement",
    text="""Refinement with the shipped weights, scored on views that were never shown. `offline`: learned passes, then
gradient steps, after the stream. `online`: `steps` gradient steps after each chunk; `chunk s` is the median time of a
chunk with them. `wrong poses`: the context cameras are turned by 0.5 degrees and moved by 1 % of the depth. `poses
adjusted`: before the stream. `targets carried`: the same scene, each target moved as the context views beside it. `over
black`: holes black, exposure carried over. `own gain`: the shown image after a factor for each channel that is fitted
to the target itself, so no score of a method; its distance from `shown` is what carrying the exposure over costs.""",
    cases=cases,
    findings=findings,
)
