"""Finished streams to learn from: recipes that train on what a stream ends with, without gradients through it."""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from pathlib import Path

import jax.numpy as jnp
from jaxtyping import Array, Float

from ssplat_jax.cache import VoxelCache
from ssplat_jax.cache.key_views import KeyViews
from ssplat_jax.core.errors import InputError
from ssplat_jax.core.program_memory import make_room
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.data.split import MIN_FRAMES, choose_split
from ssplat_jax.model.streamsplat import StreamSplat, shown_pivots
from ssplat_jax.refinement import online_refinement
from ssplat_jax.refinement.refine import pairs_capacity
from ssplat_jax.refinement.refine_capture import key_views_of
from ssplat_jax.streaming.feed import feed_capture
from ssplat_jax.streaming.session import Session
from ssplat_jax.training.capture_samples import captures_in

MIN_MSE = 1e-4
"""Added to squared errors before the logarithm, so that views that are nearly right do not count most."""


@dataclasses.dataclass(frozen=True)
class SceneSources:
    """Scenes that a recipe streams: the part that such recipes share."""

    width: int = 320
    """Width of the streamed images in pixels; their height keeps the capture's shape."""
    strides: tuple[int, ...] = (1, 2)
    """A capture is streamed once with every frame, once with every second one, and so on; up to 64 views each."""
    procedural: tuple[str, ...] = (
        "procedural:room?frames=80&seed=3",
        "procedural:corridor?frames=80&seed=1",
        "procedural:orbit?frames=80&seed=2",
    )
    """Procedural scenes to learn from beside the captures."""


@dataclasses.dataclass
class StreamedScene:
    """A finished stream."""

    name: str
    cache: VoxelCache
    num_pivots: int  # those that are shown
    key_views: KeyViews  # what was streamed
    max_pairs: int  # capacity for tile intersections of a view


def captures_of(paths: Sequence[Path], sources: SceneSources, smallest: tuple[int, int]) -> list[tuple[Capture, int]]:
    """All scenes to learn from, each with its stride.

    Every capture has the width of `sources` and the shape of its first image. Strides that leave fewer than
    `MIN_FRAMES` frames of a capture are left out.

    Args:
        paths: captures, or folders of captures.
        sources: width, strides and procedural scenes.
        smallest: smallest height and width of an image.

    Returns:
        Pairs of capture and stride, the procedural scenes first.

    Raises:
        InputError: an image is smaller than `smallest`, (height, width), or a capture has too few frames.
    """
    width = sources.width
    opened = [(open_capture(spec, size=(width, width * 3 // 4)), 1) for spec in sources.procedural]
    for path in itertools.chain.from_iterable(map(captures_in, paths)):
        capture = open_capture(path, size=(width, width * 3 // 4))
        first = capture.frames[0]
        capture = dataclasses.replace(capture, height=round(first.height * width / first.width))
        strides = [stride for stride in sources.strides if len(range(0, len(capture), stride)) >= MIN_FRAMES]
        if not strides:
            wanted = f"at least {MIN_FRAMES} frames"
            raise InputError(f"train: {capture.name}: wanted {wanted}, got {len(capture)}; leave it out.")
        opened += [(capture, stride) for stride in strides]
    for capture, _ in opened:
        if capture.height < smallest[0] or capture.width < smallest[1]:
            wanted = "x".join(map(str, reversed(smallest)))
            raise InputError(f"train: {capture.name}: wanted images of {wanted} or more at width {width}.")
    return opened


def stream_scene(model: StreamSplat, params: dict, capture: Capture, stride: int) -> StreamedScene:
    """The finished stream of a capture; the targets of its interleaved split are not shown.

    Args:
        model: the model.
        params: its parameters.
        capture: the capture.
        stride: distance of consecutive frames.
    """
    make_room()
    context = choose_split("interleaved", len(capture), stride, None, None).context
    session = Session(model, params, revise=online_refinement(model))
    frame = capture.stream_frame(model.config, context)
    exposures, _ = feed_capture(session, capture, context, frame)
    assert session.cache is not None
    num_shown = int(jnp.sum(shown_pivots(session.cache, model.config)))
    key_views = key_views_of(capture, context, frame, exposures)
    return StreamedScene(
        name=f"{capture.name}, stride {stride}",
        cache=session.cache,
        num_pivots=num_shown,
        key_views=key_views,
        max_pairs=pairs_capacity(session.gaussians(), key_views, margin=2.0),  # training changes the scene
    )


def negative_psnr(image: Float[Array, "h w 3"], target: Float[Array, "h w 3"]) -> Float[Array, ""]:
    """Minus the PSNR in dB, in which easy and hard scenes count alike."""
    mse = jnp.mean((jnp.clip(image, 0.0, 1.0) - target) ** 2)
    return 10 / math.log(10) * jnp.log(mse + MIN_MSE)
