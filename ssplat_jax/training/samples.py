"""Samples of streamed views, procedural or of a capture: chunks of context views with true depths, and target views.

Every 8th frame of a capture from the 5th on, a target of the interleaved protocol, is held out:
samples of views show it neither as context nor as target, and `ssplat eval` scores it.
"""

import dataclasses
import functools
import hashlib
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ssplat_jax.config import MEDIAN_DEPTH, StreamConfig
from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.chunk import Chunk
from ssplat_jax.core.errors import InputError, refusal
from ssplat_jax.core.numerics import evenly_spread
from ssplat_jax.core.pytree import pytree, replace
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.depth_range import FAR_FACTOR, NEAR_FACTOR
from ssplat_jax.data.open_capture import is_capture, open_capture
from ssplat_jax.data.procedural.procedural_views import STEP_RANGE, training_sample
from ssplat_jax.data.split import FIRST_TARGET, TARGET_STEP
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.model.views import GRID_STRIDE

ESTIMATION_SIZE, MAX_ESTIMATION_FRAMES = (320, 240), 64
"""Width and height, and number, of the images from which scale, near and far of a capture are estimated."""


class CaptureGroup(NamedTuple):
    """Captures that together get a share of the training steps."""

    name: str
    share: float
    captures: tuple[Capture, ...]


@dataclasses.dataclass(frozen=True, eq=False)
class CaptureMix:
    """Captures to learn from. Steps that no group gets are procedural."""

    groups: tuple[CaptureGroup, ...]
    config: StreamConfig

    @property
    def share(self) -> float:
        """Share of the steps of all groups together."""
        return sum(group.share for group in self.groups)

    @property
    def captures(self) -> list[Capture]:
        """The captures of all groups."""
        return [capture for group in self.groups for capture in group.captures]

    @property
    def is_masked(self) -> bool:
        """True if some capture has masks; samples of all then have some, since they are stacked."""
        return any(capture.is_masked for capture in self.captures)

    def draw(self, rng: np.random.Generator) -> Capture | None:
        """The capture of a step, each group with its share; None for a procedural step."""
        place = rng.uniform()
        for group in self.groups:
            if place < group.share:
                return group.captures[rng.integers(len(group.captures))]
            place -= group.share
        return None

    def describe(self) -> list:
        """Facts that identify the captures in a run, as JSON types."""
        # Sizes of files stand for contents: a data set may be too large to be read at every start.
        size_of = lambda path: path and f"{path.name} {path.stat().st_size}"  # noqa: E731

        def digests(capture: Capture) -> tuple[str, str, str]:
            files = [(size_of(frame.path), size_of(frame.depth_path), frame.depth_unit) for frame in capture.frames]
            digest = hashlib.sha256(repr(files).encode()).hexdigest()[:12]
            return capture.name, capture.digest(range(len(capture))), digest

        return [(group.name, group.share, [digests(capture) for capture in group.captures]) for group in self.groups]

    @functools.lru_cache(maxsize=1024)  # noqa: B019 - a mix lives as long as its training
    def frame_of(self, capture: Capture) -> StreamFrame:
        """Scale, near and far of a capture, estimated once from the frames that may be learned from."""
        learned = learned_frames(capture)
        places = evenly_spread(len(learned), MAX_ESTIMATION_FRAMES)
        return capture.stream_frame(self.config, [learned[i] for i in places])


@dataclasses.dataclass(frozen=True, eq=False)
class TrainingStart:
    """Inputs from which the samples of a phase are made."""

    model: StreamSplat
    params: dict  # of all stages, as the training began
    mix: CaptureMix | None
    seed: int  # of the recipe
    num_steps: int  # of the recipe
    say: Callable[[str], None]  # called with messages while scenes are prepared


def open_mix(folders: Sequence[Path], shares: Sequence[float], config: StreamConfig, total: float = 0.5) -> CaptureMix:
    """Opens captures, or folders of captures, each with its share of the steps; by default equal ones of `total`.

    Raises:
        InputError: shares do not fit, or a folder holds no capture.
    """
    shares = list(shares) or [total / len(folders)] * len(folders)
    if len(shares) != len(folders) or not all(share > 0 for share in shares) or sum(shares) > 1 + 1e-9:
        wanted = f"{len(folders)} numbers above 0 that add up to at most 1, one for each of --captures"
        raise refusal("--shares", wanted=wanted, got=" ".join(map(str, shares)), fix="give one share a folder")
    groups = []
    for folder, share in zip(folders, shares, strict=True):
        captures = tuple(open_capture(path, size=ESTIMATION_SIZE) for path in captures_in(folder))
        groups.append(CaptureGroup(folder.name, float(share), captures))
    return CaptureMix(tuple(groups), config)


def captures_in(folder: Path) -> list[Path]:
    """Paths of the captures at `folder`: itself, or else those in it."""
    if is_capture(folder) or not folder.is_dir():
        return [folder]
    # `open_capture` refuses a folder that no reader knows, with a reason.
    return sorted(path for path in folder.iterdir() if path.is_dir() and is_capture(path)) or [folder]


def learned_frames(capture: Capture) -> list[int]:
    """Frames that may be learned from."""
    return [i for i in range(len(capture)) if i % TARGET_STEP != FIRST_TARGET]


# -- samples -----------------------------------------------------------------------------------------------------------


MAX_LOG_STEP = 0.05  # log depths of neighboring pixels that differ by more belong to different surfaces
NEARLY = 1 - 1e-4  # factor that puts the sky just inside the farthest depth candidate
MAX_STRIDE = 8  # largest distance of consecutive frames of a sample, in frames that may be learned from


@pytree
class Sample:
    """`t` chunks of context views with true depths, and target views."""

    chunks: Chunk  # leading axis t
    log_depths: Float[Array, "t v hf wf"]  # true ln z at the centers of cells
    target_images: Float[Array, "s h w 3"]
    target_camera: Camera  # leading axis s
    is_photographed: Bool[Array, ""]  # by a camera that may choose another exposure for each view
    target_seen: Bool[Array, "s h w"] | None = None  # False for masked pixels, which give no loss; None: all count


@dataclasses.dataclass(frozen=True)
class ViewSamples:
    """Samples of a phase that streams views anew in every step, so that gradients flow through the network."""

    num_chunks: int  # chunks streamed through the cache per sample
    sizes: tuple[tuple[int, int], ...]
    """Image sizes (height, width), used alternately; one program is compiled per size."""
    num_targets: int = 0  # novel views per sample
    batch: int = 1  # samples per step; the loss is their mean
    steps_of_depth: tuple[float, float] = STEP_RANGE
    """Range of the distance between consecutive procedural views in median depths: from hand-held video to photo sets.
    Some samples cannot be matched at all, so that confidence learns to say so."""
    kinds: tuple[str, ...] = ()
    """Kinds of procedural worlds, of which each sample draws one; repeated ones are more likely. Empty: all kinds but
    yards, with the shares of `data/procedural/scenes.py`."""
    range_jitter: float = 0.25
    """Largest error of scene scale, near and far (log of a factor), for robustness to estimated ones."""

    def __post_init__(self) -> None:
        if min(self.num_chunks, self.batch) < 1 or self.num_targets < 0 or not self.sizes:
            raise InputError(f"recipe: wanted num_chunks and batch of at least 1 and an image size, got {self}.")

    def check(self, mix: CaptureMix, config: StreamConfig, *, renders: bool) -> None:
        """Refuses captures that cannot teach the phase; without `renders` it learns from depth maps alone."""
        needed = self.num_chunks * config.stream.chunk_size + self.num_targets
        for capture in mix.captures:
            learned = learned_frames(capture)
            if len(learned) < needed:
                wanted = f"at least {needed} frames besides those held out, as a sample of the recipe has"
                raise refusal(f"--captures {capture.name}", wanted=wanted, got=len(learned), fix="leave it out")
            if not renders and not any(map(capture.pixels.has_depth, learned)):
                wanted = "depth maps, from which alone this recipe learns"
                fix = "leave it out, or choose a recipe that renders target views, such as stream"
                raise refusal(f"--captures {capture.name}", wanted=wanted, got="none", fix=fix)

    def open(self, start: TrainingStart) -> Callable[[int, int], Sample]:
        """Makes the samples of a step, stacked, from its number and its place in the phase, and from nothing else."""
        mix, seed = start.mix, start.seed

        def sample(number: int, size: tuple[int, int]) -> Sample:
            if mix is not None and (capture := mix.draw(np.random.default_rng([seed, number, 13]))) is not None:
                made = capture_sample(self, mix, capture, [seed, number, 17], size)
            else:
                made = procedural_sample(self, seed * 1_000_003 + number, size, start.model.config)
            return _all_seen(made) if mix is not None and mix.is_masked and made.target_seen is None else made

        def batch(step: int, place: int) -> Sample:
            numbers = range(step, step + self.batch * start.num_steps, start.num_steps)
            size = self.sizes[place % len(self.sizes)]
            with jax.default_device(_cpu()):
                return jax.tree.map(lambda *parts: jnp.stack(parts), *[sample(number, size) for number in numbers])

        return batch


def _cpu():
    """The device that makes samples: the CPU, or JAX's default (None) where `JAX_PLATFORMS` leaves the CPU out."""
    try:
        return jax.local_devices(backend="cpu")[0]
    except RuntimeError:
        return None


def procedural_sample(views: ViewSamples, seed: int, size: tuple[int, int], config: StreamConfig) -> Sample:
    """A sample of a procedural world, at `size` (height, width); the same for the same arguments.

    Raises:
        InputError: there are targets, but only one context view.
    """
    rng = np.random.default_rng([seed, 7])
    num_context = views.num_chunks * config.stream.chunk_size
    if views.num_targets and num_context < 2:
        raise InputError("training: wanted context views around targets, got a context of one view; use no targets.")
    num_views = num_context + views.num_targets
    arrays = training_sample(seed, num_views, *size, steps=views.steps_of_depth, kinds=views.kinds)
    images, depths, camtoworlds, Ks = (np.asarray(a) for a in arrays)
    targets = _choose_targets(rng, num_views, views.num_targets)
    context = np.setdiff1d(np.arange(num_views), targets)

    seen, jitter = depths[context][np.isfinite(depths[context])], views.range_jitter
    scale = float(MEDIAN_DEPTH / np.median(seen) * np.exp(rng.uniform(-jitter, jitter)))
    low, high = np.quantile(seen * scale, [0.01, 0.99])
    near = NEAR_FACTOR * low * np.exp(rng.uniform(-jitter, jitter))
    far = FAR_FACTOR * high * np.exp(rng.uniform(-jitter, jitter))
    relative = np.linalg.inv(camtoworlds.astype(np.float64)[context[0]]) @ camtoworlds.astype(np.float64)
    relative[:, :3, 3] *= scale
    return _sample_of_views(
        images=images,
        # No candidate is as far as the sky. The last one stands for it, which draws it behind everything else, where
        # its error shows least.
        depths=np.where(np.isfinite(depths), depths * scale, NEARLY * far),
        viewmats=np.linalg.inv(relative).astype(np.float32),
        Ks=Ks,
        context=context,
        targets=targets,
        near=near,
        far=far,
        is_photographed=False,
        config=config,
    )


def _all_seen(sample: Sample) -> Sample:
    """The sample with masks that hide nothing, to be stacked with samples that have masks."""
    context, targets = (np.ones(images.shape[:-1], bool) for images in (sample.chunks.images, sample.target_images))
    return replace(sample, chunks=replace(sample.chunks, seen=jnp.asarray(context)), target_seen=jnp.asarray(targets))


def _choose_targets(rng: np.random.Generator, num_views: int, num_targets: int) -> np.ndarray:
    """Ascending positions of `num_targets` targets, drawn among `num_views` views but the first and the last."""
    if not num_targets:
        return np.zeros(0, int)
    return np.sort(rng.choice(np.arange(1, num_views - 1), size=num_targets, replace=False))


def capture_sample(
    views: ViewSamples, mix: CaptureMix, capture: Capture, seed: Sequence[int], size: tuple[int, int]
) -> Sample:
    """A sample of frames that may be learned from, at `size` (height, width); the same for the same arguments."""
    rng = np.random.default_rng(seed)
    num_views = views.num_chunks * mix.config.stream.chunk_size + views.num_targets
    frames = _window(rng, learned_frames(capture), num_views)
    chosen = set(_choose_targets(rng, num_views, views.num_targets).tolist())
    context = [i for place, i in enumerate(frames) if place not in chosen]
    targets = [i for place, i in enumerate(frames) if place in chosen]
    height, width = size
    delivered = dataclasses.replace(capture, height=height, width=width)
    known, jitter = mix.frame_of(capture), views.range_jitter
    context = delivered.stream_order(mix.config, context, known)
    scale, near, far = np.exp(rng.uniform(-jitter, jitter, 3))
    first = capture.frames[context[0]].camtoworld
    stream_frame = StreamFrame.at_camera(
        first, scale=known.scale * scale, near=known.near * scale * near, far=known.far * scale * far
    )
    frames = [*context, *targets]
    return _sample_of_views(
        images=np.stack([delivered.image(i) for i in frames]),
        depths=np.stack([stream_frame.scale * _depth(delivered, i) for i in frames]),
        viewmats=stream_frame.viewmats(capture.camtoworlds[frames]),
        Ks=np.stack([delivered.K(i) for i in frames]),
        context=np.arange(len(context)),
        targets=np.arange(len(context), len(frames)),
        near=stream_frame.near,
        far=stream_frame.far,
        is_photographed=True,
        config=mix.config,
        seen=np.array([delivered.seen(i) for i in frames]) if capture.is_masked else None,
    )


def _window(rng: np.random.Generator, frames: list[int], count: int) -> list[int]:
    """`count` frames at equal distances, the distance drawn log-uniformly and the place uniformly."""
    widest = min(MAX_STRIDE, (len(frames) - 1) // max(count - 1, 1))
    stride = round(math.exp(rng.uniform(0.0, math.log(widest)))) if widest > 1 else 1
    first = int(rng.integers(len(frames) - stride * (count - 1)))
    return frames[first : first + stride * (count - 1) + 1 : stride]


def _depth(capture: Capture, i: int) -> np.ndarray:
    """Depth map of a frame, capture units, NaN where unknown: losses leave such cells out."""
    depth = capture.depth(i)
    if depth is None:
        return np.full((capture.height, capture.width), np.nan, np.float32)
    return np.where(depth > 0, depth, np.nan)


def _sample_of_views(
    *, images, depths, viewmats, Ks, context, targets, near, far, is_photographed: bool, config: StreamConfig, seen=None
) -> Sample:
    """Sample of the views at the places `context`, chunk by chunk, and `targets`; NumPy arrays, stream units."""
    num_chunks = len(context) // config.stream.chunk_size
    chunked = lambda x: jnp.asarray(x[context].reshape(num_chunks, config.stream.chunk_size, *x.shape[1:]))  # noqa: E731
    height, width = images.shape[1:3]
    Ks = Ks.astype(np.float32)
    return Sample(
        chunks=Chunk(
            images=chunked(images),
            viewmats=chunked(viewmats),
            Ks=chunked(Ks),
            valid=jnp.ones((num_chunks, config.stream.chunk_size), bool),
            near=jnp.full(num_chunks, near, jnp.float32),
            far=jnp.full(num_chunks, far, jnp.float32),
            seen=None if seen is None else chunked(seen),
        ),
        log_depths=chunked(log_depths_at_cells(depths)),
        target_images=jnp.asarray(images[targets]),
        target_camera=Camera(jnp.asarray(viewmats[targets]), jnp.asarray(Ks[targets]), width, height),
        is_photographed=jnp.asarray(is_photographed),
        target_seen=None if seen is None else jnp.asarray(seen[targets]),
    )


def log_depths_at_cells(depths: Float[np.ndarray, "*b h w"]) -> Float[np.ndarray, "*b hf wf"]:
    """Log depths at the centers of cells, the common corners of four pixels: means over the four.

    Limits:
        NaN where one of the four is NaN.
    """
    before = GRID_STRIDE // 2 - 1
    # Cells whose center is on the edge of the image are left out: they have pixels on one side only.
    rows, cols = ((side - before - 2) // GRID_STRIDE + 1 for side in depths.shape[-2:])
    corners = [(y, x) for y in (before, before + 1) for x in (before, before + 1)]
    around = np.log([depths[..., y::GRID_STRIDE, x::GRID_STRIDE][..., :rows, :cols] for y, x in corners])
    # At an edge of depth the mean of the four would lie on no surface: one of them is taken.
    is_edge = np.ptp(around, axis=0) > MAX_LOG_STEP
    return np.where(is_edge, around[-1], around.mean(axis=0)).astype(np.float32)
