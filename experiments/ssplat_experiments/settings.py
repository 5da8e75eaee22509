"""Settings that `accuracy_vs_time` measures, and how one is measured: quality, time and memory, refined or not."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

from ssplat_experiments.streams import START_CAPACITY, new_session
from ssplat_jax.config import StreamConfig, preset
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.split import Split
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.evaluation.cost import measure_latency, peak_memory
from ssplat_jax.evaluation.metrics import installed_lpips
from ssplat_jax.evaluation.scoring import mean_scores, score_views
from ssplat_jax.refinement.compared_views import FOR_CAPTURES
from ssplat_jax.refinement.refine import Progress, key_views_of
from ssplat_jax.streaming.session import Exposures, feed_capture


@dataclasses.dataclass(frozen=True)
class Sizes:
    """Context views, and (width, height) of the scored images."""

    context: int
    scored: tuple[int, int]
    settings: int | None = None  # number of `SETTINGS` that are measured, without refinement; None: all, with it


SIZES = {
    "smoke": Sizes(8, (64, 48), settings=1),
    "cpu": Sizes(24, (160, 120)),
    "gpu": Sizes(64, (320, 240)),
}


@dataclasses.dataclass(frozen=True)
class Setting:
    """A point of the plot: the size that is streamed, as a factor, and what differs from the preset."""

    factor: float = 1.0  # size of the streamed images against that of the scored ones
    label: str = ""
    changes: dict[str, Any] = dataclasses.field(default_factory=dict)
    refine_steps: int = 0  # refinement steps on the streamed views after the stream
    quality: str = ""  # name of the `--quality` with this setting, or empty

    @property
    def name(self) -> str:
        """The factor of the size, if it is not 1, the label and the steps; `preset` without all."""
        size = "" if self.factor == 1 else f"size x {self.factor:g}"
        steps = f"{self.refine_steps} steps" if self.refine_steps else ""
        return ", ".join(part for part in (size, self.label, steps) if part) or "preset"

    def size(self, scored: tuple[int, int]) -> tuple[int, int]:
        """(width, height) of the streamed images."""
        return round(self.factor * scored[0]), round(self.factor * scored[1])


SETTINGS = (
    Setting(quality="accurate"),
    Setting(0.5, quality="fast"),
    Setting(0.75, quality="balanced"),
    Setting(1.5),
    Setting(1.0, "1 Gaussian a token", {"gaussians_per_token": 1}),
    Setting(1.0, "4 Gaussians a token", {"gaussians_per_token": 4}),
    Setting(1.0, "exposure not matched", {"match_exposure": False}),
    Setting(1.0, "1 pivot", {"pivots_per_voxel": 1}),
    Setting(1.0, "chunks of 8", {"chunk_size": 8}),
    Setting(1.0, "no carving", {"carving": False}),
    Setting(1.0, "no evidence head", {"evidence": False}),
    Setting(1.0, "no detail", {"detail": False}),
)

REFINED_FACTORS = (0.5, 1.0)
REFINED_STEPS = (24, 100)
REFINED = tuple(
    Setting(factor, refine_steps=steps, quality="best" if (factor, steps) == (1.0, 100) else "")
    for factor in REFINED_FACTORS
    for steps in REFINED_STEPS
)
"""The second axis: sizes of the stream times steps of refinement. `SETTINGS` has the same sizes without steps."""


Opened = Callable[[tuple[int, int]], tuple[Capture, Split]]  # opens a scene with images of a (width, height)


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
    stream_frame: StreamFrame
    exposures: Exposures
    cost: dict[str, Any]

    def row(self, setting: Setting, gaussians: Gaussians) -> dict[str, Any]:
        """A row of the table, with the scores of `gaussians`."""
        given = (self.scored, self.split.targets, self.stream_frame, self.exposures, installed_lpips())
        scores = mean_scores(score_views(gaussians, *given))
        row = {"setting": setting.name} | {kind: round(scores[kind]["psnr"], 3) for kind in ("shown", "literal")}
        row |= {f"{kind}_{name}": scores[kind][name] for kind in ("shown", "literal") for name in ("ssim", "lpips")}
        return row | self.cost


def measure(setting: Setting, sizes: Sizes, opened: Opened) -> dict[str, Any]:
    """One row: quality, time and memory of a setting on a scene, without refinement."""
    scene = _stream(setting, sizes, opened)
    return scene.row(setting, scene.gaussians)


def measure_refined(settings: Sequence[Setting], sizes: Sizes, opened: Opened) -> list[dict[str, Any]]:
    """A row for each setting of one streamed size, which differ in the number of refinement steps alone.

    The steps are those of one refinement that is planned for the most of them: fewer steps have higher rates at their
    end than a refinement of their own would have. Where it ends early, settings of more steps get the scene at its end.
    Their time, the median of a step times the steps, is spread over the streamed views.
    """
    scene, rows = _stream(settings[0], sizes, opened), []
    wanted = sorted(setting.refine_steps for setting in settings)
    given = key_views_of(scene.streamed, scene.split.context, scene.stream_frame, scene.exposures)
    progress = Progress.start(scene.gaussians, given, FOR_CAPTURES)
    refined = {}
    for _ in progress.steps(wanted[-1]):
        if progress.num_steps in wanted:
            refined[progress.num_steps] = progress.scene(scene.gaussians)
    last = progress.scene(scene.gaussians)
    for setting in settings:
        seconds = progress.report().seconds_per_step * min(setting.refine_steps, progress.num_steps)
        gaussians = refined.get(setting.refine_steps, last)
        row = scene.row(setting, gaussians) | {"gaussians": int((gaussians.opacities > 0).sum())}
        added = 1e3 * seconds / len(scene.split.context)
        rows.append(row | {"ms_per_view": round(row["ms_per_view"] + added, 2), "refine_s": round(seconds, 2)})
    return rows


def _stream(setting: Setting, sizes: Sizes, opened: Opened) -> _Streamed:
    """Streams a setting on a scene and measures time and memory of the stream."""
    session = new_session(config_of(setting, sizes))
    compiled = session.compile_seconds
    (capture, split), (scored, _) = opened(setting.size(sizes.scored)), opened(sizes.scored)
    stream_frame = capture.stream_frame(session.model.config, split.context)
    exposures, recent = feed_capture(session, capture, split.context, stream_frame, num_recent=2)
    camera = scored.camera(split.targets[len(split.targets) // 2], stream_frame)
    latency = measure_latency(session, recent, camera)
    cost = {
        "ms_per_view": round(latency["chunk_ms"]["median"] / session.model.config.stream.chunk_size, 2),
        "chunk_ms": latency["chunk_ms"]["median"],
        "render_ms": latency["render_ms"],
        "compile_s": round(session.compile_seconds - compiled, 1),
        "gaussians": session.cache_facts()["decoded"],
        "peak_memory_bytes": peak_memory(session, camera)["peak_memory_bytes"],
    }
    return _Streamed(session.gaussians(), capture, scored, split, stream_frame, exposures, cost)
