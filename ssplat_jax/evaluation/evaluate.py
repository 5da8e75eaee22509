"""Quality and cost on one capture: stream the context, decode the cache, render views that were never shown."""

import dataclasses
import io
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from ssplat_jax.cache import ensure_room
from ssplat_jax.chunk import Chunk
from ssplat_jax.console import Reporter
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.split import Split
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.errors import InputError
from ssplat_jax.gaussians import Gaussians, mean_color
from ssplat_jax.metrics.lpips import LpipsWeights, check_size, lpips
from ssplat_jax.metrics.psnr_ssim import SSIM_ARGUMENTS, psnr, ssim
from ssplat_jax.rasterizer import fill_holes, render
from ssplat_jax.storage.atomic import write_atomic
from ssplat_jax.storage.folders import make_writable, remove_numbered
from ssplat_jax.storage.json_files import write_json
from ssplat_jax.streaming.session import Session, tokens_per_chunk
from ssplat_jax.streaming.streamsplat import ChunkOutput, shown_pivots

LATENCY_CHUNKS = 4  # the last chunks are fed again to the full cache, each this often, to time them warm
LATENCY_REPEATS = 3

EXPOSURE_VIEWS = 3  # streamed views whose exposures are averaged for a novel one

Images = Float[np.ndarray, "h w 3"]
Exposures = dict[int, Float[np.ndarray, "3"]]
"""Of each streamed frame, what takes the scene's colors to the frame's."""


@dataclasses.dataclass(frozen=True)
class ViewScore:
    """One target view."""

    frame: int
    psnr: float  # dB, at the exposure of the nearest streamed views, holes in the colors around
    psnr_over_black: float  # dB, at that exposure
    psnr_one_exposure: float  # dB, at the scene's exposure, holes in the colors around
    ssim: float
    lpips: float | None  # None without weights
    coverage: float  # mean alpha: how much of the view the scene covers


def stream_context(
    session: Session,
    capture: Capture,
    split: Split,
    frame: StreamFrame,
    on_chunk: Callable[[int], None] = lambda n: None,
) -> tuple[Exposures, list]:
    """Feeds the context to `session`; calls `on_chunk(views so far)`.

    Returns:
        The exposures of the context, and the last few chunks, for timing.
    """
    recent: list = []
    exposures: Exposures = {}
    config = session.model.config
    order = capture.stream_order(config, split.context, frame)
    for chunk in capture.chunks(config, order, frame=frame):
        exposures |= exposures_of(session.feed(chunk), chunk, order[len(exposures) :])
        recent = [*recent, chunk][-LATENCY_CHUNKS:]
        on_chunk(len(exposures))
    return exposures, recent


def exposures_of(output: ChunkOutput, chunk: Chunk, frames: Sequence[int]) -> Exposures:
    """Exposures of the views of a chunk, which are the first of `frames`."""
    seen = np.asarray(output.exposures)[np.asarray(chunk.valid)]
    return dict(zip(frames[: len(seen)], seen, strict=True))


def exposures_to_json(exposures: Exposures) -> dict[str, list[float]]:
    """As results and saved states hold them, to the last bit."""
    return {str(i): np.asarray(exposures[i], np.float64).tolist() for i in sorted(exposures)}


def exposures_from_json(fields: dict[str, list[float]]) -> Exposures:
    """Inverse of `exposures_to_json`."""
    return {int(i): np.array(exposure, np.float32) for i, exposure in fields.items()}


def exposure_for(capture: Capture, i: int, exposures: Exposures) -> Float[np.ndarray, "3"]:
    """The exposure to show frame `i` at: its own if it was streamed, else the mean (of logs) of the nearest views'."""
    if not exposures:
        return np.ones(3)
    nearest = [i] if i in exposures else nearest_contexts(capture, i, tuple(exposures))[:EXPOSURE_VIEWS]
    return np.exp(np.mean([np.log(np.asarray(exposures[j], np.float64)) for j in nearest], axis=0))


_lpips, _filled = jax.jit(lpips), jax.jit(fill_holes)


def check_scorable(capture: Capture) -> None:
    """Refuses images that SSIM's window does not fit in.

    Raises:
        InputError: a side is below 11 pixels.
    """
    if min(capture.width, capture.height) < (least := SSIM_ARGUMENTS["win_size"]):
        raise InputError(
            f"{capture.name}: wanted images of at least {least} pixels a side, got {capture.width}x{capture.height};"
            " give a larger --size."
        )


def score_view(
    gaussians: Gaussians,
    capture: Capture,
    i: int,
    frame: StreamFrame,
    exposures: Exposures,
    lpips_weights: LpipsWeights | None = None,
) -> tuple[ViewScore, Images, Float[np.ndarray, "h w"]]:
    """Score, clipped color and depth (stream units, 0 where nothing is) of frame `i`.

    The scene has one exposure; the view is shown at that of the nearest streamed views (`exposure_for`), about what a
    camera there would have had. The score without is given too.

    What the Gaussians leave open is shown in the colors around, or in the scene's mean color (`fill_holes`). Black, a
    color like any other, would make a hole the worst of errors (docs/decisions.md); the score over it is given too.
    """
    out = render(gaussians, capture.camera(i, frame))
    assert out.color is not None and out.alpha is not None
    exposure = exposure_for(capture, i, exposures)
    filled = np.asarray(_filled(out.color, out.alpha, mean_color(gaussians)))
    color, over_black = (
        np.clip(image * exposure, 0.0, 1.0).astype(np.float32) for image in (filled, np.asarray(out.color))
    )
    target = capture.image(i)
    distance = None if lpips_weights is None else float(_lpips(lpips_weights, jnp.asarray(color), jnp.asarray(target)))
    score = ViewScore(
        frame=i,
        psnr=psnr(color, target),
        psnr_over_black=psnr(over_black, target),
        psnr_one_exposure=psnr(np.clip(filled, 0.0, 1.0), target),
        ssim=ssim(color, target),
        lpips=distance,
        coverage=float(np.asarray(out.alpha).mean()),
    )
    return score, color, np.asarray(out.depth)


def mean_psnr(
    gaussians: Gaussians, capture: Capture, targets: tuple[int, ...], frame: StreamFrame, exposures: Exposures
) -> float:
    """Mean over targets of the PSNR, in dB."""
    return float(np.mean([score_view(gaussians, capture, i, frame, exposures)[0].psnr for i in targets]))


def nearest_contexts(capture: Capture, target: int, context: tuple[int, ...]) -> list[int]:
    """Context frames, those of near poses first: center distance over the context's span, plus angle between axes."""
    poses = capture.camtoworlds
    centers = poses[list(context), :3, 3]
    span = max(float(np.linalg.norm(centers.max(axis=0) - centers.min(axis=0))), 1e-12)
    distances = np.linalg.norm(centers - poses[target, :3, 3], axis=1) / span
    cosines = np.einsum("vi,i->v", poses[list(context), :3, 2], poses[target, :3, 2])
    return [context[j] for j in np.argsort(distances + np.arccos(np.clip(cosines, -1, 1)), kind="stable")]


def baselines(capture: Capture, split: Split) -> dict[str, float]:
    """What needs no reconstruction: copying the nearest context view, and one mean color for everything."""
    mean_color = np.mean([capture.image(i).mean(axis=(0, 1)) for i in split.context], axis=0)
    copies, flats = [], []
    for i in split.targets:
        target = capture.image(i)
        copies.append(psnr(capture.image(nearest_contexts(capture, i, split.context)[0]), target))
        flats.append(psnr(np.broadcast_to(mean_color, target.shape).astype(np.float32), target))
    return {"nearest_view_psnr": round(float(np.mean(copies)), 4), "mean_color_psnr": round(float(np.mean(flats)), 4)}


def measure_latency(session: Session, chunks: list, camera) -> dict:
    """Chunk in -> one novel view out on the full cache, everything compiled, each result waited for. Milliseconds."""
    totals, renders = [], []
    cache, config = session.cache, session.model.config
    assert cache is not None
    # Growing happens a few times in a stream's life and is no part of what a chunk costs; a stream that fitted is not
    # refused for what is fed again.
    policy = config.replace(overflow="grow") if config.memory.overflow == "error" else config
    roomy = ensure_room(cache, policy, tokens_per_chunk(chunks[0], config.network.size_multiple))
    for chunk in chunks:
        for repeat in range(LATENCY_REPEATS + 1):
            session.cache = jax.block_until_ready(jax.tree.map(jnp.copy, roomy))
            since = time.perf_counter()
            session.feed(chunk)
            gaussians = jax.block_until_ready(session.gaussians())
            decoded = time.perf_counter()
            jax.block_until_ready(render(gaussians, camera).color)
            done = time.perf_counter()
            if repeat:  # the first may compile the renderer for this number of pairs
                totals.append(1e3 * (done - since))
                renders.append(1e3 * (done - decoded))
    session.cache = cache
    return {
        "chunk_ms": {"median": round(float(np.median(totals)), 1), "p99": round(float(np.quantile(totals, 0.99)), 1)},
        "render_ms": round(float(np.median(renders)), 1),
    }


def cache_facts(session: Session) -> dict:
    """Occupancy and counters of the session's cache; `decoded`: Gaussians that it shows."""
    cache, config = session.cache, session.model.config
    assert cache is not None
    stats = {field.name: int(getattr(cache.stats, field.name)) for field in dataclasses.fields(cache.stats)}
    return {
        "voxels": int(cache.num_voxels),
        "pivots": int(cache.counts.sum()),
        "decoded": config.head.gaussians_per_token * int(shown_pivots(cache, config).sum()),
        "capacity": cache.capacity,
        "overflow": stats["num_dropped"],
        "accepted_fraction": round(stats["num_accepted"] / max(stats["num_seen"], 1), 4),
        **stats,
    }


def evaluate(
    session: Session,
    capture: Capture,
    split: Split,
    out: Path,
    reporter: Reporter | None = None,
    *,
    streamed: Capture | None = None,
    lpips_weights: LpipsWeights | None = None,
) -> dict:
    """Streams, scores and times; writes `metrics.json`, `split.json` and a picture per target into `out`.

    A picture is target | render | depth. `split.json` holds the frames used; its SHA-256 is in the metrics.

    `capture` is scored; `streamed` (default: `capture` itself) is the same at the size that is streamed. Every frame is
    decoded once before anything is written, so that a damaged one leaves no half of a result. Without `lpips_weights`
    the fields `lpips` are null.

    Raises:
        InputError: a frame is damaged or too small to be scored, or the capture lies in `out`.
        StorageError: `out` cannot be written.
    """
    check_scorable(capture)
    if lpips_weights is not None:
        check_size(capture.height, capture.width)
    capture.check_apart(out)
    capture.verify((*split.context, *split.targets))
    make_writable(out)  # before the long part
    remove_numbered(out, "view_#####.png")  # of another split
    streamed = streamed or capture
    frame = streamed.stream_frame(session.model.config, split.context)
    reporter = reporter or Reporter(quiet=True)
    for warning in (*capture.notes, *filter(None, [frame.warning])):
        reporter.warn(warning)
    reference = baselines(capture, split)
    with reporter.progress("streaming", len(split.context)) as advance:
        exposures, recent = stream_context(session, streamed, split, frame, advance)
    gaussians = session.gaussians()
    facts = cache_facts(session)
    stream = {  # before timing, which may make room that the stream did not need
        "compile_s": round(session.compile_seconds, 2),
        "compilations": session.num_compilations,
        "step_memory_bytes": session.step_memory_bytes,
    }
    scores = []
    for i in split.targets:
        score, color, depth = score_view(gaussians, capture, i, frame, exposures, lpips_weights)
        scores.append(score)
        save_comparison(out / f"view_{i:05d}.png", capture.image(i), color, depth, (frame.near, frame.far))
    distances = [s.lpips for s in scores if s.lpips is not None]
    middle = split.targets[len(split.targets) // 2]
    latency = measure_latency(session, recent, capture.camera(middle, frame))
    metrics = {
        "capture": capture.name,
        "size": [capture.width, capture.height],
        "streamed_size": [streamed.width, streamed.height],
        "protocol": split.protocol,
        "split_sha256": split.sha256,
        "context_views": len(split.context),
        "target_views": len(split.targets),
        "psnr": round(float(np.mean([s.psnr for s in scores])), 4),
        "psnr_over_black": round(float(np.mean([s.psnr_over_black for s in scores])), 4),
        "psnr_one_exposure": round(float(np.mean([s.psnr_one_exposure for s in scores])), 4),
        "ssim": round(float(np.mean([s.ssim for s in scores])), 4),
        "ssim_arguments": SSIM_ARGUMENTS,
        "lpips": round(float(np.mean(distances)), 4) if distances else None,
        **latency,
        **stream,
        "cache": facts,
        "num_gaussians": facts["decoded"],
        "config_hash": session.model.config.hash,
        "stream_frame": {"scale": frame.scale, "near": frame.near, "far": frame.far, "warning": frame.warning},
        "baselines": reference,
        "exposures": exposures_to_json(exposures),
        "per_view": [dataclasses.asdict(s) for s in scores],
    }
    write_atomic(out / "split.json", split.to_json().encode())
    write_json(out / "metrics.json", metrics)
    return metrics


# -- pictures ---------------------------------------------------------------------------------------------------------

_DEPTH_COLORS = np.array(  # near to far, perceptually even, readable in print
    [(0.99, 0.91, 0.62), (0.97, 0.60, 0.32), (0.80, 0.27, 0.37), (0.47, 0.13, 0.48), (0.13, 0.07, 0.33)], np.float32
)


def color_depth(depth: Float[np.ndarray, "h w"], near: float, far: float) -> Images:
    """Log depth as color, light near and dark far; black where there is none."""
    position = np.log(np.maximum(depth, 1e-9) / near) / np.log(far / near)
    stops = np.linspace(0.0, 1.0, len(_DEPTH_COLORS))
    channels = [np.interp(position, stops, _DEPTH_COLORS[:, c]) for c in range(3)]
    return np.where(depth[..., None] > 0, np.stack(channels, axis=-1), 0.0).astype(np.float32)


def save_image(path: Path, image: Images) -> None:
    """Writes an image in [0, 1] as an 8-bit file of the format that the suffix names.

    Raises:
        StorageError: the file cannot be written.
    """
    encoded = io.BytesIO()
    Image.fromarray(eight_bits(image)).save(encoded, Image.registered_extensions()[path.suffix])
    write_atomic(path, encoded.getvalue())


def eight_bits(image: Images) -> UInt8[np.ndarray, "h w 3"]:
    """An image in [0, 1] in steps of 1/255."""
    return (np.clip(image, 0.0, 1.0) * 255 + 0.5).astype(np.uint8)


def save_comparison(path: Path, target: Images, color: Images, depth, depth_range: tuple[float, float]) -> None:
    """target | render | depth, side by side."""
    save_image(path, np.concatenate([target, color, color_depth(depth, *depth_range)], axis=1))
