"""Training samples from captures: photographs with known poses, and depth maps where a capture has them.

Every 8th frame of a capture from the 5th on, a target of the interleaved protocol, is held out: samples to learn from
show it neither as context nor as target, and `validation_sample` shows it as target.
"""

import dataclasses
import functools
import hashlib
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ssplat_jax.config import StreamConfig
from ssplat_jax.core.errors import refusal
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.open_capture import is_capture, open_capture
from ssplat_jax.data.split import FIRST_TARGET, TARGET_STEP
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.training.recipe import Recipe
from ssplat_jax.training.samples import Sample, choose_targets, sample_of_views

ESTIMATION_SIZE = (320, 240)
"""Width and height of the images from which scale, near and far of a capture are estimated."""
MAX_ESTIMATION_FRAMES = 64
"""Frames, evenly spread, from which they are estimated."""
MAX_STRIDE = 8
"""Largest distance of consecutive frames of a sample, in frames that may be learned from."""


@dataclasses.dataclass(frozen=True, eq=False)
class CaptureGroup:
    """Captures that together get a share of the training steps."""

    name: str
    share: float
    captures: tuple[Capture, ...]

    def describe(self) -> dict:
        """Facts that identify the group in a run, as JSON types."""
        digests = [capture.digest(range(len(capture))) for capture in self.captures]
        files = {f"{i} {capture.name}": _files_digest(capture) for i, capture in enumerate(self.captures)}
        return {"name": self.name, "share": self.share, "captures": digests, "files": files}


def _files_digest(capture: Capture) -> str:
    """Digest (12 hex digits) of the names and sizes of a capture's depth maps and the sizes of its images.

    Sizes stand for contents: a data set may be too large to be read at every start.
    """
    digest = hashlib.sha256()
    for frame in capture.frames:
        for path in (frame.path, frame.depth_path):
            digest.update(b"none\n" if path is None else f"{path.stat().st_size}\n".encode())
        depth = None if frame.depth_path is None else frame.depth_path.name
        digest.update(f"{depth} {frame.depth_unit}\n".encode(errors="surrogateescape"))
    return digest.hexdigest()[:12]


@dataclasses.dataclass(frozen=True, eq=False)
class CaptureMix:
    """Captures to learn from. Steps that no group gets are procedural."""

    groups: tuple[CaptureGroup, ...]
    config: StreamConfig

    def describe(self) -> list[dict]:
        """Facts that identify the captures in a run, as JSON types."""
        return [group.describe() for group in self.groups]

    def draw(self, rng: np.random.Generator) -> Capture | None:
        """The capture of a step, each group with its share; None for a procedural step."""
        place = rng.uniform()
        for group in self.groups:
            if place < group.share:
                return group.captures[rng.integers(len(group.captures))]
            place -= group.share
        return None

    def validation_captures(self, most: int) -> list[Capture]:
        """At most `most` captures, evenly spread over all."""
        every = [capture for group in self.groups for capture in group.captures]
        return [every[i] for i in np.unique(np.linspace(0, len(every) - 1, most).round().astype(int))]

    @functools.lru_cache(maxsize=1024)  # noqa: B019 - a mix lives as long as its training
    def frame_of(self, capture: Capture) -> StreamFrame:
        """Scale, near and far of a capture, estimated once from the frames that may be learned from."""
        learned = learned_frames(capture)
        places = np.linspace(0, len(learned) - 1, min(len(learned), MAX_ESTIMATION_FRAMES)).round().astype(int)
        return capture.stream_frame(self.config, [learned[i] for i in places])


def open_mix(folders: Sequence[Path], shares: Sequence[float], config: StreamConfig, recipe: Recipe) -> CaptureMix:
    """Opens captures to learn from.

    Args:
        folders: captures, or folders of captures.
        shares: share of the steps of each folder; empty: half of the steps, equally.
        config: configuration of the model.
        recipe: says how many views a sample has, and whether it renders any.

    Raises:
        InputError: shares do not fit, a folder holds no capture, or a capture cannot teach this recipe: it has too few
            frames for a sample, or no depth map where the recipe renders no target view.
    """
    shares = list(shares) or [0.5 / len(folders)] * len(folders)
    if len(shares) != len(folders) or not all(share > 0 for share in shares) or sum(shares) > 1 + 1e-9:
        wanted = f"{len(folders)} numbers above 0 that add up to at most 1, one for each of --captures"
        raise refusal("--shares", wanted=wanted, got=" ".join(map(str, shares)), fix="give one share a folder")
    needed = max(p.num_chunks * config.stream.chunk_size + p.num_targets for p in recipe.phases)
    groups = []
    for folder, share in zip(folders, shares, strict=True):
        captures = tuple(open_capture(path, size=ESTIMATION_SIZE) for path in captures_in(folder))
        for capture in captures:
            if (count := len(learned_frames(capture))) < needed:
                wanted = f"at least {needed} frames besides those held out, as a sample of the recipe has"
                raise refusal(f"--captures {capture.name}", wanted=wanted, got=str(count), fix="leave it out")
            if not recipe.renders and not any(map(capture.pixels.has_depth, learned_frames(capture))):
                wanted = "depth maps, from which alone this recipe learns"
                fix = "leave it out, or choose a recipe that renders target views, such as stream"
                raise refusal(f"--captures {capture.name}", wanted=wanted, got="none", fix=fix)
        groups.append(CaptureGroup(folder.name, float(share), captures))
    return CaptureMix(tuple(groups), config)


def captures_in(folder: Path) -> list[Path]:
    """The captures at a path: itself, or else those in it.

    Args:
        folder: a capture, or a folder of captures.

    Returns:
        Their paths; `folder` where no reader knows any, which `open_capture` explains.
    """
    if is_capture(folder) or not folder.is_dir():
        return [folder]
    return sorted(path for path in folder.iterdir() if path.is_dir() and is_capture(path)) or [folder]


def learned_frames(capture: Capture) -> list[int]:
    """Frames that may be learned from."""
    return [i for i in range(len(capture)) if i % TARGET_STEP != FIRST_TARGET]


def capture_sample(
    mix: CaptureMix,
    capture: Capture,
    seed: Sequence[int],
    *,
    num_chunks: int,
    num_targets: int,
    size: tuple[int, int],
    config: StreamConfig,
    range_jitter: float = Recipe.range_jitter,
) -> Sample:
    """A sample of frames that may be learned from, the same for the same arguments.

    Args:
        mix: knows the depth range of `capture`.
        capture: the capture.
        seed: seed of the choice of frames and of the jitter.
        num_chunks: chunks of context views.
        num_targets: target views, between the context views.
        size: height and width of the images.
        config: gives the chunk size.
        range_jitter: see `Recipe`.
    """
    rng = np.random.default_rng(seed)
    num_views = num_chunks * config.stream.chunk_size + num_targets
    frames = _window(rng, learned_frames(capture), num_views)
    chosen = set(choose_targets(rng, num_views, num_targets).tolist()) if num_targets else set()
    context = [i for place, i in enumerate(frames) if place not in chosen]
    targets = [i for place, i in enumerate(frames) if place in chosen]
    return _sample(mix, capture, context, targets, size, config, rng, range_jitter)


def validation_sample(
    mix: CaptureMix,
    capture: Capture,
    seed: Sequence[int],
    *,
    num_chunks: int,
    size: tuple[int, int],
    config: StreamConfig,
) -> Sample:
    """A sample whose one target is held out, between context views that are not.

    Args:
        mix: knows the depth range of `capture`.
        capture: the capture.
        seed: seed of the choice of frames.
        num_chunks: chunks of context views.
        size: height and width of the images.
        config: gives the chunk size.

    Limits:
        Without a held-out frame between the context views, the nearest one beside them is taken.
    """
    rng = np.random.default_rng(seed)
    context = _window(rng, learned_frames(capture), num_chunks * config.stream.chunk_size)
    held_out = range(FIRST_TARGET, len(capture), TARGET_STEP)
    middle = (context[0] + context[-1]) / 2
    target = min(held_out, key=lambda i: abs(i - middle))
    return _sample(mix, capture, context, [target], size, config, rng, 0.0)


def _window(rng: np.random.Generator, frames: list[int], count: int) -> list[int]:
    """`count` frames at equal distances, the distance drawn log-uniformly and the place uniformly."""
    widest = min(MAX_STRIDE, (len(frames) - 1) // max(count - 1, 1))
    stride = round(math.exp(rng.uniform(0.0, math.log(widest)))) if widest > 1 else 1
    first = int(rng.integers(len(frames) - stride * (count - 1)))
    return frames[first : first + stride * (count - 1) + 1 : stride]


def _sample(mix, capture, context, targets, size, config, rng, range_jitter) -> Sample:
    """The sample of these frames; context views in the order of streaming."""
    height, width = size
    delivered = dataclasses.replace(capture, height=height, width=width)
    known = mix.frame_of(capture)
    context = delivered.stream_order(config, context, known)
    scale, near, far = np.exp(rng.uniform(-range_jitter, range_jitter, 3))
    frame = StreamFrame.at_camera(
        capture.frames[context[0]].camtoworld,
        scale=known.scale * scale,
        near=known.near * scale * near,
        far=known.far * scale * far,
    )
    frames = [*context, *targets]
    return sample_of_views(
        images=np.stack([delivered.image(i) for i in frames]),
        depths=np.stack([frame.scale * _depth(delivered, i) for i in frames]),
        viewmats=frame.viewmats(capture.camtoworlds[frames]),
        Ks=np.stack([delivered.K(i) for i in frames]),
        context=np.arange(len(context)),
        targets=np.arange(len(context), len(frames)),
        near=frame.near,
        far=frame.far,
        config=config,
    )


def _depth(capture: Capture, i: int) -> np.ndarray:
    """Depth map of a frame, capture units, NaN where unknown: losses leave such cells out."""
    depth = capture.depth(i)
    if depth is None:
        return np.full((capture.height, capture.width), np.nan, np.float32)
    return np.where(depth > 0, depth, np.nan)
