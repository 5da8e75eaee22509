"""Quality and cost on one capture: stream the context, decode the cache, score views that were never streamed.

Every view is scored twice: `literal` as the paper's words define, over black at the exposure of the scene, and `shown`
as a person sees it, at about the exposure that a camera there would have had, with holes filled. In most scenes black
is far from the true color, so a score over black rewards a method that covers holes with blobs. The filling uses
nothing but the rendered image, its alpha and the scene's mean color.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from ssplat_jax.core.atomic import write_atomic
from ssplat_jax.core.console import Reporter
from ssplat_jax.core.errors import refusal
from ssplat_jax.core.false_colors import color_depth
from ssplat_jax.core.gaussians import Gaussians, mean_color
from ssplat_jax.core.kept_programs import Kept
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.split import Split, index_to_json
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.evaluation.cost import NUM_CHUNKS, measure_latency, peak_memory
from ssplat_jax.evaluation.metrics import LPIPS_MIN_SIDE, SSIM_ARGUMENTS, LpipsWeights, lpips, psnr, ssim
from ssplat_jax.evaluation.pictures import save_image
from ssplat_jax.poses.adjust_poses import adjust_and_say, check_look_ahead
from ssplat_jax.rasterizer import effects_for, fill_holes, render
from ssplat_jax.refinement.compared_views import FOR_CAPTURES
from ssplat_jax.refinement.refine import Progress, key_views_of
from ssplat_jax.storage.files import write_json
from ssplat_jax.storage.run_folder import RunFolder, make_writable
from ssplat_jax.streaming.session import Exposures, Session, begin_stream, feed_capture, middle_exposure

NUM_AVERAGED = 3  # streamed frames whose exposures are averaged for a novel view

_jitted_lpips = Kept(lpips)
_filled = Kept(lambda out, gaussians: fill_holes(out.color, out.alpha, mean_color(gaussians)))


@dataclasses.dataclass(frozen=True)
class ImageScore:
    """Scores of one image against its target."""

    psnr: float  # dB
    ssim: float
    lpips: float | None  # None without weights


@dataclasses.dataclass(frozen=True)
class ViewScore:
    """Scores of one view: `literal` as the paper defines them, `shown` of the image that a person is shown.

    The scene's own exposure is that of the files that are written of it, `middle_exposure`.
    """

    frame: int
    literal: ImageScore  # holes black, at the scene's exposure
    shown: ImageScore  # holes filled, at the exposure of the nearest streamed views
    coverage: float  # mean alpha: how much of the view the scene covers


@dataclasses.dataclass(frozen=True)
class ScoredView:
    """A rendered view, its scores, and the image that it was compared with."""

    score: ViewScore
    target: Float[np.ndarray, "h w 3"]
    color: Float[np.ndarray, "h w 3"]  # what `score.shown` compares
    depth: Float[np.ndarray, "h w"]  # stream units, 0 where nothing is

    def save(self, path: Path, depth_range: tuple[float, float]) -> None:
        """Writes target | render | depth side by side; `depth_range` are the ends of the color scale, stream units.

        Raises:
            StorageError: the file cannot be written.
        """
        save_image(path, np.concatenate([self.target, self.color, color_depth(self.depth, *depth_range)], axis=1))


def check_scorable(capture: Capture, *, with_lpips: bool = False) -> None:
    """Refuses images that are smaller than SSIM's window, or than LPIPS needs.

    Raises:
        InputError: a side is below 11 pixels, or below 16.
    """
    min_side = LPIPS_MIN_SIDE if with_lpips else SSIM_ARGUMENTS["win_size"]
    if min(capture.width, capture.height) < min_side:
        wanted, got = f"images of at least {min_side} pixels a side", f"{capture.width}x{capture.height}"
        raise refusal(capture.name, wanted=wanted, got=got, fix="give a larger --size")


def nearest_views(capture: Capture, i: int, candidates: Sequence[int]) -> list[int]:
    """The frames `candidates`, nearest to frame `i` first.

    The distance is that of the centers, as a fraction of the candidates' extent, plus the angle between the optical
    axes in radians.
    """
    poses = capture.camtoworlds
    centers = poses[list(candidates), :3, 3]
    extent = max(float(np.linalg.norm(centers.max(axis=0) - centers.min(axis=0))), 1e-12)
    distances = np.linalg.norm(centers - poses[i, :3, 3], axis=1) / extent
    cosines = np.einsum("vi,i->v", poses[list(candidates), :3, 2], poses[i, :3, 2])
    return [candidates[j] for j in np.argsort(distances + np.arccos(np.clip(cosines, -1, 1)), kind="stable")]


def exposures_to_json(exposures: Exposures) -> dict[str, list[float]]:
    """Exposures of streamed frames as results and saved states hold them; exact."""
    return {str(i): np.asarray(exposures[i], np.float64).tolist() for i in sorted(exposures)}


def exposures_from_json(fields: dict[str, list[float]]) -> Exposures:
    """The inverse of `exposures_to_json`."""
    return {int(i): np.array(exposure, np.float32) for i, exposure in fields.items()}


def exposure_for(capture: Capture, i: int, exposures: Exposures) -> Float[np.ndarray, "3"]:
    """The exposure to show frame `i` at: its own if it was streamed, else the geometric mean of the nearest frames'."""
    if not exposures:
        return np.ones(3)
    nearest = [i] if i in exposures else nearest_views(capture, i, tuple(exposures))[:NUM_AVERAGED]
    return np.exp(np.mean([np.log(np.asarray(exposures[j], np.float64)) for j in nearest], axis=0))


def score_view(
    gaussians: Gaussians,
    capture: Capture,
    i: int,
    stream_frame: StreamFrame,
    exposures: Exposures,
    lpips_weights: LpipsWeights | None = None,
) -> ScoredView:
    """Renders frame `i` of a capture and scores it.

    Args:
        gaussians: the scene, in the stream frame.
        capture: the capture with the target image.
        i: the frame to score.
        stream_frame: the similarity between the capture's frame and the stream's.
        exposures: exposures of the streamed frames; may be empty.
        lpips_weights: with them LPIPS is scored too.

    Raises:
        InputError: the image is damaged.
    """
    camera = capture.camera(i, stream_frame)
    out = render(gaussians, camera, effects=effects_for(gaussians, camera))
    shown = np.asarray(_filled(out, gaussians)) * exposure_for(capture, i, exposures)
    literal = np.asarray(out.color) * middle_exposure(exposures)
    shown, literal = (np.clip(image, 0.0, 1.0).astype(np.float32) for image in (shown, literal))
    target, seen = capture.image(i), capture.seen(i)
    score = ViewScore(
        frame=i,
        literal=score_image(literal, target, lpips_weights, seen),
        shown=score_image(shown, target, lpips_weights, seen),
        coverage=float(np.asarray(out.alpha).mean()),
    )
    return ScoredView(score, target, shown, np.asarray(out.depth))


def score_image(
    image: Float[np.ndarray, "h w 3"],
    target: Float[np.ndarray, "h w 3"],
    lpips_weights: LpipsWeights | None = None,
    seen: Bool[np.ndarray, "h w"] | None = None,
) -> ImageScore:
    """Scores of an image in [0, 1] against its target; pixels that are not `seen` do not count.

    For LPIPS, which has no pixels, these are equal in both images.
    """
    distance = None
    if lpips_weights is not None:
        image = image if seen is None else np.where(seen[..., None], image, target)
        distance = float(_jitted_lpips(lpips_weights, jnp.asarray(image), jnp.asarray(target)))
    return ImageScore(psnr(image, target, seen), ssim(image, target, seen), distance)


def mean_scores(scores: Sequence[ViewScore]) -> dict[str, Any]:
    """Means over views: `{"literal": {"psnr", "ssim", "lpips"}, "shown": {...}}`; `lpips` is None without weights."""
    return {name: mean_images([getattr(s, name) for s in scores]) for name in ("literal", "shown")}


def mean_images(scores: Sequence[ImageScore]) -> dict[str, float | None]:
    """Means of `psnr`, `ssim` and `lpips`, the last None without weights; NaN is the score of a fully masked view."""
    means = {}
    for name in ("psnr", "ssim", "lpips"):
        found = [value for score in scores if (value := getattr(score, name)) is not None and not math.isnan(value)]
        means[name] = round(float(np.mean(found)), 4) if found else None
    return means


def score_views(
    gaussians: Gaussians,
    capture: Capture,
    frames: Sequence[int],
    stream_frame: StreamFrame,
    exposures: Exposures,
    lpips_weights: LpipsWeights | None = None,
    picture: Callable[[int], Path] | None = None,
) -> list[ViewScore]:
    """Scores of frames by `score_view`, with a picture of each at the path that `picture` names.

    Raises:
        StorageError: a picture cannot be written.
    """
    scores = []
    for i in frames:
        view = score_view(gaussians, capture, i, stream_frame, exposures, lpips_weights)
        if picture is not None:
            view.save(picture(i), stream_frame.depth_range)
        scores.append(view.score)
    return scores


def baselines(capture: Capture, split: Split) -> dict[str, float]:
    """PSNR, in dB, of copying the nearest context view and of showing the context's mean color everywhere."""
    mean_rgb = np.mean([capture.image(i).mean(axis=(0, 1)) for i in split.context], axis=0)
    copies, flats = [], []
    for i in split.targets:
        target, seen = capture.image(i), capture.seen(i)
        copies.append(psnr(capture.image(nearest_views(capture, i, split.context)[0]), target, seen))
        flats.append(psnr(np.broadcast_to(mean_rgb, target.shape).astype(np.float32), target, seen))
    return {"nearest_view_psnr": round(float(np.mean(copies)), 4), "mean_color_psnr": round(float(np.mean(flats)), 4)}


# -- evaluation of a capture -------------------------------------------------------------------------------------------


def evaluate(
    session: Session,
    capture: Capture,
    split: Split,
    out: Path,
    reporter: Reporter | None = None,
    *,
    streamed: Capture | None = None,
    lpips_weights: LpipsWeights | None = None,
    refine_steps: int = 0,
    adjust_poses: bool = False,
    scene: str | None = None,
) -> dict:
    """Streams, scores and times; writes metrics, split, index and a picture per target into `out`.

    A picture is target | render | depth. `split.json` holds the frames used, whose SHA-256 is in the metrics, and
    `index.json` holds them as an index file. Every frame is decoded once before anything is written, so that a damaged
    one leaves no partial result.

    Args:
        session: a new session with the model and its parameters.
        capture: the capture at the size at which views are scored.
        split: context frames to stream and target frames to score.
        out: folder of the results.
        reporter: shows progress and warnings; by default warnings only.
        streamed: the same capture at the size that is streamed; by default `capture`.
        lpips_weights: with them LPIPS is scored too; without, the fields `lpips` are null.
        refine_steps: refinement steps on the context views before the targets are scored. With them the metrics have a
            block `refinement`: the report of the refinement, and the scores before.
        adjust_poses: adjust the poses of the context to its images before it is streamed; targets keep theirs.
        scene: name in `index.json`; by default the capture's.

    Returns:
        The metrics as written.

    Raises:
        InputError: a frame is damaged or too small to be scored, the capture lies in `out`, `out` holds a run, or poses
            of a causal stream are to be adjusted.
        StorageError: `out` cannot be written.
    """
    folder, streamed, reporter = RunFolder(out), streamed or capture, reporter or Reporter(quiet=True)
    folder.check_no_run()
    check_look_ahead(is_asked=adjust_poses, is_causal=session.model.config.stream.causal)
    check_scorable(capture, with_lpips=lpips_weights is not None)
    capture.check_output_folder(out)
    capture.verify((*split.context, *split.targets))
    make_writable(out)  # before the long part
    folder.clear_targets()  # they may be of another split
    adjusted = adjust_and_say(streamed, split.context, reporter) if adjust_poses else None
    if adjusted is not None:  # poses of the context alone
        capture, streamed = (dataclasses.replace(x, frames=adjusted.capture.frames) for x in (capture, streamed))
    stream_frame = begin_stream(session, streamed, split.context)
    reporter.warn_all(*capture.notes, stream_frame.warning)
    reference = baselines(capture, split)
    context, keep_order = split.context, split.keeps_order
    with reporter.progress("streaming", len(context)) as advance:
        exposures, recent = feed_capture(
            session, streamed, context, stream_frame, keep_order=keep_order, num_recent=NUM_CHUNKS, on_chunk=advance
        )
    cost = {  # before the latency is measured, for which the cache may grow and a step be compiled
        "compile_s": round(session.compile_seconds, 2),
        "compilations": session.num_compilations,
        "step_memory_bytes": session.step_memory_bytes,
        "refine_memory_bytes": session.refine_memory_bytes,  # None without refinement while streaming
        "cache": (facts := session.cache_facts()),
        "num_gaussians": facts["decoded"],
    }
    gaussians, refinement = session.gaussians(), {}
    if refine_steps:
        before = mean_scores(score_views(gaussians, capture, split.targets, stream_frame, exposures, lpips_weights))
        with reporter.progress("refining", refine_steps) as advance:
            key_views = key_views_of(streamed, split.context, stream_frame, exposures)
            progress = Progress.start(gaussians, key_views, FOR_CAPTURES)
            for _ in progress.steps(refine_steps):
                advance(progress.num_steps, f"loss {progress.losses[-1]:.4f}")
        gaussians, report = progress.scene(gaussians), progress.report()
        cost["num_gaussians"] = int((gaussians.opacities > 0).sum())
        done = {name: value for name, value in vars(report).items() if name not in ("losses", "held_back")}
        refinement = {"refinement": done | {"before": before}}
    middle = capture.camera(split.targets[len(split.targets) // 2], stream_frame)
    cost["peak_memory_bytes"] = peak_memory(session, middle)["peak_memory_bytes"]
    scores = score_views(gaussians, capture, split.targets, stream_frame, exposures, lpips_weights, folder.target)
    timing = measure_latency(session, recent, middle)
    metrics = {
        "capture": capture.name,
        "size": [capture.width, capture.height],
        "streamed_size": [streamed.width, streamed.height],
        "protocol": split.protocol,
        "split_sha256": split.sha256,
        "context_views": len(split.context),
        "target_views": len(split.targets),
        **mean_scores(scores),
        "ssim_arguments": SSIM_ARGUMENTS,
        "adjusted_poses": None if adjusted is None else adjusted.reason,
        **refinement,
        **timing,
        **cost,
        "config_hash": session.model.config.hash,
        "hpda": session.model.config.is_anchored,
        "stream_frame": stream_frame.to_dict(),
        "baselines": reference,
        "exposures": exposures_to_json(exposures),
        "per_view": [dataclasses.asdict(s) for s in scores],
    }
    write_atomic(folder.split, split.to_json().encode())
    write_json(folder.index, index_to_json({scene or capture.name: split}))
    write_json(folder.metrics, metrics)
    return metrics
