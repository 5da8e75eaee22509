"""Crops of views of finished streams: samples for parts that act on the decoded cache.

A scene is streamed once, at the size of use, and its cache kept: what is rendered is what is scored. A step costs a
decoding and a rendering of what a crop shows, so that hundreds of steps take minutes on a CPU. No gradient flows
through the cache.
"""

import dataclasses
import functools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from ssplat_jax.cache.key_views import KeyViews
from ssplat_jax.cache.state import VoxelCache
from ssplat_jax.config import StreamConfig
from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.cpu_backend import make_room
from ssplat_jax.core.errors import refusal
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.core.pytree import pytree, replace, static
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.data.split import MIN_FRAMES, choose_split
from ssplat_jax.evaluation.scoring import exposure_for
from ssplat_jax.model.decoder import MAX_LOG_GAIN, START_SCALE, divide_cells, grown_footprints
from ssplat_jax.model.streamsplat import StreamSplat, shown_pivots
from ssplat_jax.rasterizer.render import count_pairs, round_up
from ssplat_jax.refinement import online_refinement
from ssplat_jax.refinement.compared_views import EFFECTS
from ssplat_jax.refinement.refine import key_views_of
from ssplat_jax.refinement.refine_step import may_be_seen, round_rows
from ssplat_jax.streaming.session import Session, feed_capture
from ssplat_jax.training.samples import CaptureMix, TrainingStart

PAIRS_COUNTED = 12  # crops of each scene whose tile intersections are counted, for the capacity of all
PAIRS_MARGIN = 2.0
"""Capacity for tile intersections over the largest number that was counted: training changes the scenes."""


@pytree
class CropSample:
    """A part of a view, and the cache that is to show it."""

    cache: VoxelCache
    camera: Camera
    image: UInt8[Array, "h w c"]  # RGB, and 0 in a fourth channel where a pixel is masked; all crops have one or none
    exposure: Float[Array, "3"]  # factors from the scene's colors to the view's
    pivots: Int[Array, " m"]  # that may be seen in the crop; -1 after the last
    num_gaussians: int = static()  # capacity for theirs
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
    width: int = 320  # width of the streamed images in pixels; their height keeps the capture's shape
    strides: tuple[int, ...] = (1, 2)
    """A capture is streamed once with every frame, once with every second one, and so on; up to 64 views each."""
    size: tuple[int, int] = (128, 160)  # height and width of the crops in pixels, at the full resolution of the views
    batch: int = 2  # crops per step, each of another scene; the loss is their mean

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
            height = round(first.height * width / first.width)
            # Without its depth maps, as most captures are streamed.
            capture = dataclasses.replace(capture, width=width, height=height, streams_depth=False)
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
        channels = max(views.images.shape[-1] for _, views in scenes)
        rng, places = np.random.default_rng(start.seed), []
        # All places at once, so that they do not depend on where a training was resumed.
        for number in range(self.batch * start.num_steps):
            num_views, height, width = scenes[number % len(scenes)][1].images.shape[:3]
            sides = (num_views, height - self.size[0] + 1, width - self.size[1] + 1)
            places.append([int(rng.integers(n)) for n in sides])

        def place(number: int) -> tuple[VoxelCache, KeyViews, Camera, slice, slice]:
            (cache, views), (view, row, column) = scenes[number % len(scenes)], places[number]
            camera = crop_camera(views.camera(view), row, column, *self.size)
            return cache, views.at(view), camera, np.s_[row : row + self.size[0]], np.s_[column : column + self.size[1]]

        # The largest capacities for all, so that one program serves every crop.
        config, counts = start.model.config, []
        for number in range(len(places)):
            cache, _, camera, *_ = place(number)
            counts.append(count_in_sight(cache, camera, config))
        num_pivots, num_gaussians = (round_rows(int(max(numbers))) for numbers in zip(*counts, strict=True))

        def crop(number: int, max_pairs: int) -> CropSample:
            cache, view, camera, rows, columns = place(number)
            image = np.asarray(view.images)[rows, columns]
            image = np.pad(image, [(0, 0), (0, 0), (0, channels - image.shape[-1])], constant_values=1)
            pivots = pivots_in_sight(cache, camera, config, num_pivots)
            return CropSample(cache, camera, jnp.asarray(image), view.exposures, pivots, num_gaussians, max_pairs)

        some = range(min(len(places), PAIRS_COUNTED * len(scenes)))
        most = max(int(_count_pairs(start.model, start.params, crop(number, 0))) for number in some)
        max_pairs = round_up(int(PAIRS_MARGIN * most))
        return lambda step, place: tuple(crop(self.batch * step + i, max_pairs) for i in range(self.batch))


def stream_scene(model: StreamSplat, params: dict, capture: Capture, stride: int) -> tuple[VoxelCache, KeyViews]:
    """Cache of a finished stream, and views of its scene: half of them were streamed, the others not shown to it.

    What was never shown is what is scored; but it is few frames, the targets of the interleaved split of every
    `stride`-th frame.
    """
    make_room()
    split = choose_split("interleaved", len(capture), stride, None, None)
    session = Session(model, params, refine=online_refinement(model))
    stream_frame = capture.stream_frame(model.config, split.context)
    exposures, _ = feed_capture(session, capture, split.context, stream_frame)
    assert session.cache is not None
    streamed = split.context[:: max(1, len(split.context) // len(split.targets))]
    frames = (*streamed[: len(split.targets)], *split.targets)
    exposures |= {i: exposure_for(capture, i, exposures) for i in split.targets}
    return session.cache, key_views_of(capture, frames, stream_frame, exposures)


@functools.partial(jax.jit, static_argnums=(2, 3))
def pivots_in_sight(cache: VoxelCache, camera: Camera, config: StreamConfig, num: int) -> Int[Array, " m"]:
    """Numbers of the first `num` shown pivots of which a Gaussian may be seen, for `decode_rows`; -1 after the last."""
    return jnp.nonzero(_in_sight(cache, camera, config), size=num, fill_value=-1)[0]


@functools.partial(jax.jit, static_argnums=2)
def count_in_sight(cache: VoxelCache, camera: Camera, config: StreamConfig) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """Number of the shown pivots of which a Gaussian may be seen, and of their Gaussians."""
    in_sight = _in_sight(cache, camera, config)
    present = divide_cells(cache.rgbs.reshape(-1, cache.rgbs.shape[-1]), config).present
    return jnp.sum(in_sight, dtype=jnp.int32), jnp.sum(in_sight[:, None] & present, dtype=jnp.int32)


def _in_sight(cache: VoxelCache, camera: Camera, config: StreamConfig) -> Bool[Array, " p"]:
    """Mask of the shown pivots of which a Gaussian may be seen."""
    footprints = grown_footprints(cache.footprints, cache.num_members, config).reshape(-1)
    # One Gaussian that encloses all: half a cell's diagonal beside the pivot, and as wide as training may make them.
    spheres = Gaussians(
        means=cache.means.reshape(-1, 3),
        quats=jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0]), (len(footprints), 1)),
        scales=jnp.tile(footprints[:, None] * (START_SCALE * math.exp(MAX_LOG_GAIN) + math.sqrt(0.5) / 3), (1, 3)),
        opacities=shown_pivots(cache, config).reshape(-1).astype(jnp.float32),
        sh=jnp.zeros((len(footprints), 1, 3)),
    )
    return may_be_seen(spheres, camera)


@functools.partial(jax.jit, static_argnums=0)
def _count_pairs(model: StreamSplat, params: dict, crop: CropSample) -> Int[Array, ""]:
    gaussians = model.decode_rows(params, crop.cache, crop.pivots, crop.num_gaussians)
    return count_pairs(gaussians, crop.camera, EFFECTS)


def crop_camera(camera: Camera, row: int, column: int, height: int, width: int) -> Camera:
    """Camera of the part of an image that begins at `row` and `column`, pixels."""
    Ks = camera.Ks.at[0, 2].add(-float(column)).at[1, 2].add(-float(row))
    return replace(camera, Ks=Ks, height=height, width=width)
