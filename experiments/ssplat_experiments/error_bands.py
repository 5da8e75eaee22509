"""Parts of the error of novel views: exposure, holes, and the size of what is wrong.

    ssplat experiment error_bands --captures path/to/captures --out runs/error_bands

Streams each scene with the shipped weights, decodes the cache and takes the squared error of the shown views apart:
what one gain per channel would remove, what lies where the scene covers less than half, and how much of the rest is
finer or coarser than 1, 2, 4 and 8 pixels (differences of Gaussian blurs, in shares of their sum). `blurred_psnr` is
that of the target itself, blurred by one pixel. Scenes are `procedural:room` and those of `ssplat experiment captures`.
"""

import dataclasses
import functools
import itertools
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from skimage.filters import gaussian

from ssplat_experiments.captures import SETTINGS
from ssplat_experiments.cases import Case, Row
from ssplat_experiments.scenes import open_room
from ssplat_experiments.study import Study, at_scale, run_study
from ssplat_jax.config import preset
from ssplat_jax.core.console import Reporter
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.data.split import Split, interleaved_split
from ssplat_jax.evaluation.psnr_ssim import psnr
from ssplat_jax.evaluation.scoring import score_view
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.rasterizer import Effects, render
from ssplat_jax.storage.weights import load_params
from ssplat_jax.streaming.feed import feed_capture
from ssplat_jax.streaming.session import Session

BANDS = (1, 2, 4, 8)
"""Widths of the blurs between two bands: standard deviations, pixels."""
COVERED = 0.5
"""Alpha below which a pixel counts as a hole."""


@dataclasses.dataclass(frozen=True)
class Sizes:
    """Most context views and targets; the size of `smoke` images, None for that of `ssplat experiment captures`."""

    context: int
    targets: int
    size: tuple[int, int] | None


SIZES = {"smoke": Sizes(8, 1, (64, 48)), "cpu": Sizes(64, 5, None)}


def run(captures: Path | None, out: Path, scale: str, reporter: Reporter) -> str:
    """Measures every available scene."""
    return run_study(STUDY, captures, out, scale, reporter)


def cases(captures: Path | None, scale: str) -> list[Case]:
    """A case for each scene."""
    sizes = at_scale(SIZES, scale)
    settings = [s for s in SETTINGS if captures is not None and (captures / s[0]).is_dir()]
    scenes = [("room", 1, 64, (160, 120)), *settings]
    config = preset("tiny")
    return [
        Case(
            name=f"{name}, stride {stride}",
            config=config,
            asked={"stride": stride, "context": min(context, sizes.context), "targets": sizes.targets, "size": size},
            measure=functools.partial(measured, name, stride, min(context, sizes.context), size, sizes, captures),
        )
        for name, stride, context, its_size in scenes
        for size in (sizes.size or its_size,)
    ]


def measured(
    name: str, stride: int, context: int, size: tuple[int, int] | None, sizes: Sizes, captures: Path | None
) -> list[Row]:
    """The row of a scene: means over its targets."""
    capture, split = _open(name, stride, context, size, captures)
    config = preset("tiny")
    frame = capture.stream_frame(config, split.context)
    session = Session(StreamSplat(config), load_params("tiny"))
    exposures, _ = feed_capture(session, capture, split.context, frame)
    gaussians, found = session.gaussians(), []
    places = np.unique(np.linspace(0, len(split.targets) - 1, sizes.targets).round().astype(int))
    for i in (split.targets[place] for place in places):
        view = score_view(gaussians, capture, i, frame, exposures)
        alpha = render(gaussians, capture.camera(i, frame), effects=Effects(outputs=("alpha",))).alpha
        found.append(error_shares(view.color, view.target, np.asarray(alpha)))
    return [
        {"scene": name, "stride": stride, "targets": len(found)}
        | {column: round(float(np.mean([row[column] for row in found])), 4) for column in found[0]}
    ]


def _open(name: str, stride: int, context: int, size: Any, captures: Path | None) -> tuple[Capture, Split]:
    if name == "room" or captures is None:
        return open_room(context, size)
    capture = open_capture(captures / name, size=size)
    return capture, interleaved_split(len(capture), stride, context)


def error_shares(
    shown: Float[np.ndarray, "h w 3"], target: Float[np.ndarray, "h w 3"], alpha: Float[np.ndarray, "h w"]
) -> dict[str, float]:
    """Scores of one view, and shares of its squared error.

    Args:
        shown: the picture, in [0, 1].
        target: the photograph.
        alpha: how much of each pixel the scene covers.

    Returns:
        `shown_psnr`; `gained_psnr`, after the best gain per channel; `blurred_psnr` of the target; `in_holes`, the
        share of the squared error at pixels that are covered by less than half; `finer_than_1` to `coarser_than_8`,
        shares of the bands of the residual after the gain.
    """
    energy = np.sum(shown * shown, axis=(0, 1))
    gains = np.sum(shown * target, axis=(0, 1)) / np.where(energy > 0, energy, 1.0)
    residual = target - shown * gains
    squared = np.sum((target - shown) ** 2, axis=-1)
    scores = {
        "shown_psnr": psnr(shown, target),
        "gained_psnr": psnr(np.clip(shown * gains, 0, 1).astype(np.float32), target),
        "blurred_psnr": psnr(_blurred(target, 1.0).astype(np.float32), target),
        "in_holes": float(squared[alpha < COVERED].sum() / max(squared.sum(), 1e-12)),
    }
    levels = [residual, *(_blurred(residual, float(width)) for width in BANDS)]
    parts = [*(a - b for a, b in itertools.pairwise(levels)), levels[-1]]
    energies = np.array([np.sum(part**2) for part in parts])
    names = ["finer_than_1", *(f"{a}_to_{2 * a}" for a in BANDS[:-1]), f"coarser_than_{BANDS[-1]}"]
    return scores | dict(zip(names, (energies / max(energies.sum(), 1e-12)).tolist(), strict=True))


def _blurred(image: Float[np.ndarray, "h w 3"], width: float) -> Float[np.ndarray, "h w 3"]:
    return gaussian(image, sigma=width, channel_axis=-1, mode="reflect", preserve_range=True)


def findings(rows: list[Row]) -> list[str]:
    """The largest part of each scene's error."""
    lines = []
    for row in rows:
        bands = {name: row[name] for name in row if name.startswith(("finer", "coarser")) or "_to_" in name}
        largest = max(bands, key=lambda name: bands[name])
        lines.append(
            f"* {row['scene']}, stride {row['stride']}: {bands[largest]:.0%} of the error is"
            f" {largest.replace('_', ' ')} px, {row['in_holes']:.0%} lies in holes, one gain a channel would give"
            f" {row['gained_psnr'] - row['shown_psnr']:+.2f} dB."
        )
    return ["\n".join(lines)]


STUDY = Study(
    name="error_bands",
    text="""Squared error of the shown views, decoded cache, means over targets. `gained_psnr` is the score after the
best gain per channel, `blurred_psnr` that of the target itself blurred by one pixel, `in_holes` the share of the error
where the scene covers less than half; the bands are shares of the residual after the gain, in pixels.""",
    cases=cases,
    findings=findings,
)
