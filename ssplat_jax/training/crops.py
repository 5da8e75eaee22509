"""Crops of the views of finished streams: samples for parts that act on the decoded cache.

A scene is streamed once, at the size of use, and its cache kept: what is rendered is what is scored, and a step costs a
decoding and a rendering, so that hundreds of steps take minutes on a CPU. No gradient flows through the cache.
"""

import dataclasses
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from ssplat_jax.cache import VoxelCache
from ssplat_jax.cache.key_views import KeyViews
from ssplat_jax.config import StreamConfig
from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.cpu_backend import make_room
from ssplat_jax.core.errors import refusal
from ssplat_jax.core.pytree import pytree, replace, static
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.data.split import MIN_FRAMES, choose_split
from ssplat_jax.model.streamsplat import StreamSplat, shown_pivots
from ssplat_jax.refinement import online_refinement
from ssplat_jax.refinement.refine import key_views_of, pairs_capacity
from ssplat_jax.streaming.feed import feed_capture
from ssplat_jax.streaming.session import Session
from ssplat_jax.training.capture_mix import CaptureMix, TrainingStart


@pytree
class CropSample:
    """A part of a streamed view, and the cache that is to show it."""

    cache: VoxelCache
    camera: Camera
    image: UInt8[Array, "h w c"]  # RGB, and 0 in a fourth channel where a pixel is masked; all crops have one or none
    exposure: Float[Array, "3"]  # factors from the scene's colors to the view's
    num_pivots: int = static()  # that are decoded
    max_pairs: int = static()  # capacity for tile intersections


@dataclasses.dataclass(frozen=True)
class Crops:
    """Samples of a phase that learns from whole streams of procedural scenes and captures."""

    procedural: tuple[str, ...] = (
        "procedural:room?frames=80&seed=3",
        "procedural:corridor?frames=80&seed=1",
        "procedural:orbit?frames=80&seed=2",
    )
    """Procedural scenes to learn from beside the captures."""
    width: int = 320
    """Width of the streamed images in pixels; their height keeps the capture's shape."""
    strides: tuple[int, ...] = (1, 2)
    """A capture is streamed once with every frame, once with every second one, and so on; up to 64 views each."""
    size: tuple[int, int] = (128, 160)
    """Height and width of the crops in pixels, at the full resolution of the views."""
    batch: int = 2
    """Crops per step, each of another scene; the loss is their mean."""

    def check(self, mix: CaptureMix, config: StreamConfig, *, renders: bool) -> None:
        """Refuses captures that cannot be streamed."""
        self.scenes(mix)

    def scenes(self, mix: CaptureMix | None) -> list[tuple[Capture, int]]:
        """All scenes to learn from, each with the distance of its frames, the procedural scenes first.

        Strides that leave fewer than `MIN_FRAMES` frames of a capture are left out.

        Raises:
            InputError: an image is smaller than a crop, or a capture has too few frames.
        """
        width = self.width
        found = [(open_capture(spec, size=(width, width * 3 // 4)), 1) for spec in self.procedural]
        for capture in mix.captures if mix else []:
            first = capture.frames[0]
            capture = dataclasses.replace(capture, width=width, height=round(first.height * width / first.width))
            strides = [stride for stride in self.strides if len(range(0, len(capture), stride)) >= MIN_FRAMES]
            if not strides:
                wanted = f"at least {MIN_FRAMES} frames"
                raise refusal(f"train: {capture.name}", wanted=wanted, got=len(capture), fix="leave it out")
            found += [(capture, stride) for stride in strides]
        for capture, _ in found:
            if capture.height < self.size[0] or capture.width < self.size[1]:
                wanted = f"images of {self.size[1]}x{self.size[0]} or more at width {width}"
                got = f"{capture.width}x{capture.height}"
                raise refusal(f"train: {capture.name}", wanted=wanted, got=got, fix="leave it out")
        return found

    def open(self, start: TrainingStart) -> Callable[[int, int], tuple[CropSample, ...]]:
        """Streams all scenes; gives the crops of a step by its number and its place in the phase."""
        scenes = []
        for capture, stride in self.scenes(start.mix):
            scenes.append(stream_scene(start.model, start.params, capture, stride))
            start.say(f"streamed {capture.name}, stride {stride}")
        # The largest capacities for all, so that one program serves every scene.
        capacities = {"num_pivots": max(scene[2] for scene in scenes), "max_pairs": max(scene[3] for scene in scenes)}
        channels = max(scene[1].images.shape[-1] for scene in scenes)
        rng, places = np.random.default_rng(start.seed), []
        # All places at once, so that they do not depend on where a training was resumed.
        for number in range(self.batch * start.num_steps):
            num_views, height, width = scenes[number % len(scenes)][1].images.shape[:3]
            places.append(
                [int(rng.integers(n)) for n in (num_views, height - self.size[0] + 1, width - self.size[1] + 1)]
            )

        def crop(number: int) -> CropSample:
            (cache, views, *_), (view, row, column) = scenes[number % len(scenes)], places[number]
            camera = crop_camera(views.camera(view), row, column, *self.size)
            image = np.asarray(views.images[view])[row : row + self.size[0], column : column + self.size[1]]
            image = np.pad(image, [(0, 0), (0, 0), (0, channels - image.shape[-1])], constant_values=1)
            return CropSample(cache, camera, jnp.asarray(image), views.exposures[view], **capacities)

        return lambda step, place: tuple(crop(self.batch * step + i) for i in range(self.batch))

    def held_out(self, mix: CaptureMix) -> list:
        """None: no step scores the frames that a stream leaves out."""
        return []


def stream_scene(
    model: StreamSplat, params: dict, capture: Capture, stride: int
) -> tuple[VoxelCache, KeyViews, int, int]:
    """Cache of a finished stream, what was streamed, number of shown pivots and capacity for tile intersections.

    The targets of the interleaved split of every `stride`-th frame are not shown.
    """
    make_room()
    context = choose_split("interleaved", len(capture), stride, None, None).context
    session = Session(model, params, refine=online_refinement(model))
    stream_frame = capture.stream_frame(model.config, context)
    exposures, _ = feed_capture(session, capture, context, stream_frame)
    assert session.cache is not None
    views = key_views_of(capture, context, stream_frame, exposures)
    num_pivots = int(jnp.sum(shown_pivots(session.cache, model.config)))
    # Twice as many as now: training changes the scene.
    return session.cache, views, num_pivots, pairs_capacity(session.gaussians(), views, margin=2.0)


def crop_camera(camera: Camera, row: int, column: int, height: int, width: int) -> Camera:
    """Camera of the part of an image that begins at `row` and `column`, pixels."""
    Ks = camera.Ks.at[0, 2].add(-float(column)).at[1, 2].add(-float(row))
    return replace(camera, Ks=Ks, height=height, width=width)
