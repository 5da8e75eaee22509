"""Measurement of one setting of `accuracy_vs_time`: quality, time and memory, without and with refinement."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax

from ssplat_experiments.memory_curve import START_CAPACITY
from ssplat_experiments.settings import Setting, Sizes
from ssplat_experiments.stopwatch import Stopwatch
from ssplat_experiments.warm_sessions import new_session
from ssplat_jax.config import StreamConfig, preset
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.split import Split
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.evaluation.cost import measure_latency, peak_memory
from ssplat_jax.evaluation.scoring import score_targets
from ssplat_jax.refinement.refine import continue_refinement, key_views_of, start_refinement
from ssplat_jax.refinement.refine_config import FOR_CAPTURES
from ssplat_jax.streaming.feed import Exposures, feed_capture

Opened = Callable[[tuple[int, int]], tuple[Capture, Split]]
"""Opens a scene with images of a (width, height)."""


def config_of(setting: Setting, sizes: Sizes) -> StreamConfig:
    """The preset with the changes; a smoke run shares the programs of other experiments, whose memory starts small."""
    small = {} if sizes.settings is None else {"capacity": START_CAPACITY}
    return preset("tiny").replace(**setting.changes, **small)


@dataclasses.dataclass(frozen=True)
class _Streamed:
    """The scene of a setting, and what was measured of the stream."""

    gaussians: Gaussians
    streamed: Capture
    scored: Capture
    split: Split
    frame: StreamFrame
    exposures: Exposures
    cost: dict[str, Any]

    def row(self, setting: Setting, gaussians: Gaussians) -> dict[str, Any]:
        """A row of the table, with the scores of `gaussians`."""
        scores = score_targets(gaussians, self.scored, self.split.targets, self.frame, self.exposures)
        return {
            "setting": setting.name,
            "shown": round(scores["shown"]["psnr"], 3),
            "literal": round(scores["literal"]["psnr"], 3),
            **self.cost,
        }


def measure(setting: Setting, sizes: Sizes, opened: Opened) -> dict[str, Any]:
    """One row: quality, time and memory of a setting on a scene, without refinement."""
    scene = _stream(setting, sizes, opened)
    return scene.row(setting, scene.gaussians)


def measure_refined(settings: Sequence[Setting], sizes: Sizes, opened: Opened) -> list[dict[str, Any]]:
    """A row for each setting of one streamed size, which differ in the number of refinement steps alone.

    The steps are those of one refinement that is planned for the most of them: fewer steps have higher rates at their
    end than a refinement of their own would have. Where it ends early, settings of more steps get the scene at its end.
    Their time is spread over the streamed views.
    """
    scene, watch, rows = _stream(settings[0], sizes, opened), Stopwatch(), []
    by_steps = {setting.refine_steps: setting for setting in settings}
    with watch.running():
        given = key_views_of(scene.streamed, scene.split.context, scene.frame, scene.exposures)
        progress, views = start_refinement(scene.gaussians, given, FOR_CAPTURES)

    def add_rows(reached: list[Setting]) -> None:
        """Adds a row of the present scene for each setting."""
        with watch.running():
            refined = jax.block_until_ready(progress.scene(scene.gaussians))
        added = 1e3 * watch.seconds / len(scene.split.context)
        for setting in reached:
            row = scene.row(setting, refined) | {"gaussians": int((refined.opacities > 0).sum())}
            row |= {"ms_per_view": round(row["ms_per_view"] + added, 2), "refine_s": round(watch.seconds, 2)}
            rows.append(row)

    for _ in watch.over(continue_refinement(progress, views, max(by_steps), FOR_CAPTURES)):
        if progress.num_steps in by_steps:
            add_rows([by_steps[progress.num_steps]])
    if later := [setting for steps, setting in by_steps.items() if steps > progress.num_steps]:
        add_rows(later)
    return rows


def _stream(setting: Setting, sizes: Sizes, opened: Opened) -> _Streamed:
    """Streams a setting on a scene and measures time and memory of the stream."""
    session = new_session(config_of(setting, sizes))
    compiled = session.compile_seconds
    (capture, split), (scored, _) = opened(setting.size(sizes.scored)), opened(sizes.scored)
    frame = capture.stream_frame(session.model.config, split.context)
    exposures, recent = feed_capture(session, capture, split.context, frame, num_recent=2)
    camera = scored.camera(split.targets[len(split.targets) // 2], frame)
    latency = measure_latency(session, recent, camera)
    cost = {
        "ms_per_view": round(latency["chunk_ms"]["median"] / session.model.config.stream.chunk_size, 2),
        "chunk_ms": latency["chunk_ms"]["median"],
        "render_ms": latency["render_ms"],
        "compile_s": round(session.compile_seconds - compiled, 1),
        "gaussians": session.cache_facts()["decoded"],
        "peak_memory_bytes": peak_memory(session, camera).bytes,
    }
    return _Streamed(session.gaussians(), capture, scored, split, frame, exposures, cost)
