"""Scores of rendered views against their images, and the baselines to compare them with."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ssplat_jax.data.capture import Capture
from ssplat_jax.data.split import Split
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.errors import InputError
from ssplat_jax.evaluation.exposures import exposure_for
from ssplat_jax.evaluation.nearest_views import nearest_views
from ssplat_jax.gaussians import Gaussians, mean_color
from ssplat_jax.metrics.lpips import LpipsWeights, lpips
from ssplat_jax.metrics.psnr_ssim import SSIM_ARGUMENTS, psnr, ssim
from ssplat_jax.rasterizer import fill_holes, render
from ssplat_jax.streaming.feed import Exposures

_jitted_lpips, _jitted_fill_holes = jax.jit(lpips), jax.jit(fill_holes)


@dataclasses.dataclass(frozen=True)
class ViewScore:
    """Scores of one view."""

    frame: int
    psnr: float  # dB, holes filled, at the exposure of the nearest streamed views
    psnr_over_black: float  # dB, holes black, at that exposure
    psnr_one_exposure: float  # dB, holes filled, at the scene's exposure
    ssim: float  # of the image that `psnr` compares
    lpips: float | None  # of the same image; None without weights
    coverage: float  # mean alpha: how much of the view the scene covers


@dataclasses.dataclass(frozen=True)
class ScoredView:
    """A rendered view, its scores, and the image that it was compared with."""

    score: ViewScore
    target: Float[np.ndarray, "h w 3"]
    color: Float[np.ndarray, "h w 3"]  # what `score.psnr` compares: holes filled, exposed, clipped to [0, 1]
    depth: Float[np.ndarray, "h w"]  # stream units, 0 where nothing is


def check_scorable(capture: Capture) -> None:
    """Refuses images that are smaller than SSIM's window.

    Raises:
        InputError: a side is below 11 pixels.
    """
    if min(capture.width, capture.height) < (min_side := SSIM_ARGUMENTS["win_size"]):
        raise InputError(
            f"{capture.name}: wanted images of at least {min_side} pixels a side, got {capture.width}x{capture.height};"
            " give a larger --size."
        )


def score_view(
    gaussians: Gaussians,
    capture: Capture,
    i: int,
    frame: StreamFrame,
    exposures: Exposures,
    lpips_weights: LpipsWeights | None = None,
) -> ScoredView:
    """Renders frame `i` of a capture and scores it.

    The scene has one exposure; the view is shown at that of the nearest streamed views (`exposure_for`), which is about
    what a camera there would have had. Holes are filled with the colors around them (`fill_holes`), or with the scene's
    mean color: black, a color like any other, would make a hole the largest error of all (docs/decisions.md). The
    scores without either are given too.

    Args:
        gaussians: the scene, in the stream frame.
        capture: the capture with the target image.
        i: the frame to score.
        frame: the similarity between the capture's frame and the stream's.
        exposures: exposures of the streamed frames; may be empty.
        lpips_weights: with them LPIPS is scored too.

    Raises:
        InputError: the image is damaged.
    """
    out = render(gaussians, capture.camera(i, frame))
    assert out.color is not None and out.alpha is not None
    exposure = exposure_for(capture, i, exposures)
    filled = np.asarray(_jitted_fill_holes(out.color, out.alpha, mean_color(gaussians)))
    color, over_black = (
        np.clip(image * exposure, 0.0, 1.0).astype(np.float32) for image in (filled, np.asarray(out.color))
    )
    target, distance = capture.image(i), None
    if lpips_weights is not None:
        distance = float(_jitted_lpips(lpips_weights, jnp.asarray(color), jnp.asarray(target)))
    score = ViewScore(
        frame=i,
        psnr=psnr(color, target),
        psnr_over_black=psnr(over_black, target),
        psnr_one_exposure=psnr(np.clip(filled, 0.0, 1.0), target),
        ssim=ssim(color, target),
        lpips=distance,
        coverage=float(np.asarray(out.alpha).mean()),
    )
    return ScoredView(score, target, color, np.asarray(out.depth))


def mean_psnr(
    gaussians: Gaussians, capture: Capture, targets: tuple[int, ...], frame: StreamFrame, exposures: Exposures
) -> float:
    """Mean PSNR of the target views.

    Args:
        gaussians: the scene, in the stream frame.
        capture: the capture with the target images.
        targets: frame numbers to score.
        frame: the similarity between the capture's frame and the stream's.
        exposures: exposures of the streamed frames.

    Returns:
        The mean in dB.
    """
    return float(np.mean([score_view(gaussians, capture, i, frame, exposures).score.psnr for i in targets]))


def baselines(capture: Capture, split: Split) -> dict[str, float]:
    """PSNR, in dB, of copying the nearest context view and of showing the context's mean color everywhere."""
    mean_rgb = np.mean([capture.image(i).mean(axis=(0, 1)) for i in split.context], axis=0)
    copies, flats = [], []
    for i in split.targets:
        target = capture.image(i)
        copies.append(psnr(capture.image(nearest_views(capture, i, split.context)[0]), target))
        flats.append(psnr(np.broadcast_to(mean_rgb, target.shape).astype(np.float32), target))
    return {"nearest_view_psnr": round(float(np.mean(copies)), 4), "mean_color_psnr": round(float(np.mean(flats)), 4)}
