"""Streaming the frames of a capture through a session, chunk by chunk, with the exposure of every frame."""

import dataclasses
import time
from collections.abc import Callable, Iterator, Sequence

import jax
import numpy as np
from jaxtyping import Float

from ssplat_jax.core.chunk import Chunk
from ssplat_jax.core.pytree import replace
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.model.streamsplat import ChunkOutput
from ssplat_jax.streaming.live_views import widen_range
from ssplat_jax.streaming.session import Session

Exposures = dict[int, Float[np.ndarray, "3"]]
"""RGB factor per streamed frame that takes the scene's colors to the colors of that frame."""


def middle_exposure(exposures: Exposures) -> Float[np.ndarray, "3"]:
    """The median over streamed frames of their exposures, per channel; 1 without frames.

    Scenes are shown at this exposure, because the first views, whose exposure the cache keeps, may have been taken in
    the shade.
    """
    if not exposures:
        return np.ones(3)
    return np.exp(np.median(np.log(np.stack(list(exposures.values())).astype(np.float64)), axis=0))


@dataclasses.dataclass(frozen=True)
class FedChunk:
    """One chunk after the session has processed it."""

    chunk: Chunk
    frames: list[int]  # frame numbers of the chunk's valid views, in their order
    output: ChunkOutput
    stream_frame: StreamFrame  # of the next chunk: with `causal`, near and far may have moved outward
    seconds: float  # of the step, without compiling it

    @property
    def exposures(self) -> Exposures:
        """The exposures of `frames`."""
        valid = np.asarray(self.output.exposures)[np.asarray(self.chunk.valid)]
        return dict(zip(self.frames, valid, strict=True))


def begin_stream(session: Session, capture: Capture, indices: Sequence[int]) -> StreamFrame:
    """The stream frame of the frames `indices`; meanwhile the step of a new stream compiles on another thread."""
    traits = {"is_masked": capture.is_masked, "brings_depth": capture.brings_depth}
    session.compile_ahead(capture.width, capture.height, len(indices), **traits)
    return capture.stream_frame(session.model.config, indices)


def feed_chunks(
    session: Session, capture: Capture, order: Sequence[int], stream_frame: StreamFrame
) -> Iterator[FedChunk]:
    """Feeds frames of a capture to a session and yields after each chunk.

    With `causal`, near and far of a chunk follow from the chunks before it (`streaming.live_views`).

    Args:
        session: the stream; its cache grows in place.
        capture: where the images come from.
        order: frame numbers in stream order (`Capture.stream_order`); may be empty.
        stream_frame: the similarity between the capture's frame and the stream's.
    """
    config, size = session.model.config, session.model.config.stream.chunk_size
    if len(order) == 0:
        return
    session.expected_chunks = max(session.expected_chunks, -(-len(order) // size))
    for number, chunk in enumerate(capture.chunks(config, order, stream_frame=stream_frame)):
        frames = list(order[number * size : (number + 1) * size])
        if config.stream.causal:
            near, far = jax.device_put((np.float32(stream_frame.near), np.float32(stream_frame.far)))
            chunk = replace(chunk, near=near, far=far)
        since, compiled = time.perf_counter(), session.compile_seconds
        output = session.feed(chunk)
        seconds = time.perf_counter() - since - (session.compile_seconds - compiled)
        if config.stream.causal:
            stream_frame = widen_range(stream_frame, output, config)
        yield FedChunk(chunk, frames, output, stream_frame, seconds)


def feed_capture(
    session: Session,
    capture: Capture,
    indices: Sequence[int],
    stream_frame: StreamFrame,
    *,
    keep_order: bool = False,
    num_recent: int = 0,
    on_chunk: Callable[[int], None] = lambda num_views: None,
) -> tuple[Exposures, list[Chunk]]:
    """Feeds all frames `indices` of a capture to a session, in stream order unless `keep_order`.

    Args:
        session: the stream; its cache grows in place.
        capture: where the images come from.
        indices: frame numbers, in any order.
        stream_frame: the similarity between the capture's frame and the stream's.
        keep_order: stream `indices` in their order, without interleaving.
        num_recent: how many of the last chunks to return.
        on_chunk: called after each chunk with the number of views fed so far.

    Returns:
        The exposures of the frames, and the last `num_recent` chunks.
    """
    exposures: Exposures = {}
    recent: list[Chunk] = []
    order = list(indices) if keep_order else capture.stream_order(session.model.config, indices, stream_frame)
    for fed in feed_chunks(session, capture, order, stream_frame):
        exposures |= fed.exposures
        recent = [*recent, fed.chunk][-num_recent:] if num_recent else []
        on_chunk(len(exposures))
    return exposures, recent
