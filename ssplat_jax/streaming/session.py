"""`Session`: one stream on the host. It holds and grows the cache and compiles the step once per shape.

Captures are fed to it chunk by chunk, with the exposure of every frame.
"""

import dataclasses
import functools
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ssplat_jax.cache.state import VoxelCache, check_cache, ensure_capacity, init_cache, with_refinement
from ssplat_jax.config import StreamConfig
from ssplat_jax.core.chunk import Chunk, check_chunk
from ssplat_jax.core.errors import refusal
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.core.kept_programs import Kept
from ssplat_jax.core.numerics import power_of_two
from ssplat_jax.core.pytree import replace
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.model.streamsplat import ChunkOutput, StreamSplat, count_gaussians, shown_pivots
from ssplat_jax.model.views import GRID_STRIDE
from ssplat_jax.streaming.live_views import LiveViews, widen_range

INITIAL_CHUNKS = 4  # a new cache has capacity for this many chunks in which every token opens a voxel

NEW_SHARE = 0.75  # share of a stream's tokens for which the first cache has rows: others meet a voxel that is there
MOST_ROWS = 1 << 17  # rows of a first cache; unused rows slow a step

MIN_DECODED_PIVOTS = 1 << 15
"""Least number of pivots decoded at once: with fewer, compiling for a growing scene costs more than it saves."""

RefineChunk = Callable[[dict, VoxelCache, Chunk, ChunkOutput], VoxelCache]
"""Refinement after a chunk: parameters, the cache after the step, the chunk, the step's summary -> the cache."""


class Session:
    """One stream of one image size.

    Args:
        model: the model to run.
        params: the model's parameters.
        cache: the cache to continue from; by default an empty one with capacity for a few chunks.
        stream_frame: stream frame of `cache`, for `push`; by default that of the first chunk that is pushed.
        refine: what refines the scene after each chunk, as `stream.steps_per_chunk` asks
            (`ssplat_jax.refinement.online_refinement`); None where it asks for nothing.
    """

    def __init__(
        self,
        model: StreamSplat,
        params: dict,
        cache: VoxelCache | None = None,
        *,
        stream_frame: StreamFrame | None = None,
        refine: RefineChunk | None = None,
    ) -> None:
        self.model, self.params, self.cache = model, params, cache
        self._live, self._refine_chunk = LiveViews(model.config, stream_frame), refine
        self.least_decoded = MIN_DECODED_PIVOTS  # pivots; callers that often decode a growing scene raise it
        self.expected_chunks = INITIAL_CHUNKS  # of the stream, as far as the caller knows; sets the first capacity
        self.compile_seconds, self.num_compilations = 0.0, 0  # seconds that the stream waited for its programs
        # Compiled programs by name and shapes.
        self._programs: dict[tuple, jax.stages.Compiled] = {}
        self._ahead: dict[tuple, Future[jax.stages.Compiled]] = {}  # what `compile_ahead` has begun
        # Programs that the last chunk ran.
        self._step_program: jax.stages.Compiled | None = None
        self._refine_program: jax.stages.Compiled | None = None

    def compile_ahead(
        self, width: int, height: int, num_views: int, *, is_masked: bool = False, brings_depth: bool = False
    ) -> None:
        """Begins to compile the step of a new stream on another thread, while the caller prepares its first chunk.

        A first chunk of other shapes compiles its own step. Nothing begins for a session that has a cache, or that
        refines while it streams: its shapes are others.

        Args:
            width: of the images, pixels.
            height: likewise.
            num_views: views of the stream, as far as the caller knows.
            is_masked: chunks have masks.
            brings_depth: chunks have depth maps.
        """
        config = self.model.config
        if self.cache is not None or config.stream.steps_per_chunk:
            return
        size, image = config.stream.chunk_size, (height, width)
        self.expected_chunks = max(self.expected_chunks, -(-num_views // size))
        chunk = jax.eval_shape(
            lambda: Chunk(
                images=jnp.zeros((size, *image, 3)),
                viewmats=jnp.zeros((size, 4, 4)),
                Ks=jnp.zeros((size, 3, 3)),
                valid=jnp.zeros(size, bool),
                near=jnp.zeros(()),
                far=jnp.zeros(()),
                seen=jnp.zeros((size, *image), bool) if is_masked else None,
                depths=jnp.zeros((size, *image)) if brings_depth else None,
            )
        )
        num_tokens = tokens_per_chunk(chunk, config.network.size_multiple)
        capacity = starting_capacity(config, num_tokens, self.expected_chunks)
        cache = jax.eval_shape(functools.partial(init_cache, config, capacity))
        key = _program_key("step", cache, chunk)
        if key not in self._programs:
            pool = ThreadPoolExecutor(1)
            program = Kept(self.model.step, donate_argnums=(1,)).program
            self._ahead[key] = pool.submit(program, self.params, cache, chunk)
            pool.shutdown(wait=False)

    def feed(self, chunk: Chunk) -> ChunkOutput:
        """Streams one chunk into the cache and waits until it is done.

        If interrupted, the cache is either unchanged or fully updated.

        Raises:
            CacheError: tokens were dropped although the overflow policy forbids it.
            InputError: the configuration asks for refinement and `refine` is not given, or the reverse; or the chunk
                cannot be streamed, see `StreamSplat.step`.
        """
        return self._stream(chunk, is_live=False)

    def push(
        self, image: object, K: object, viewmat: object, seen: object = None, depth: object = None
    ) -> ChunkOutput | None:
        """Takes one view of a live source, and streams a chunk when enough views have come.

        Near, far and scale come from the first chunk, as with `causal`; `stream_frame` then holds them. A later chunk
        that contradicts near or far moves them outward for the chunks after it (`streaming.live_views`).

        Args:
            image: RGB, height x width x 3, as float in [0, 1] or as uint8.
            K: 3x3 intrinsics, pixels; the center of the first pixel is (0.5, 0.5).
            viewmat: 4x4 world-to-camera transform with OpenCV axes, in any world of one scale.
            seen: mask, height x width, False for pixels that do not count; by default all count. Some views may have
                masks and others none.
            depth: what a sensor measured, height x width: camera z in the unit of the poses, 0 where unknown. Some
                views may have it and others not.

        Returns:
            The summary of the chunk that the view completed, or None while views are missing.

        Raises:
            InputError: a value cannot be used, or the image has another size than the first.
            CacheError: see `feed`.
        """
        if self.cache is not None and self.stream_frame is None:
            fix = "give Session(..., stream_frame=StreamFrame) too, or push all views"
            raise refusal("push", wanted="the stream frame of the cache that is continued", got="none", fix=fix)
        chunk = self._live.add(image, K, viewmat, seen, depth)
        return None if chunk is None else self._stream(chunk, is_live=True)

    def flush(self) -> ChunkOutput | None:
        """Streams the views that wait for their chunk, however few, padded with invalid ones; None if none wait.

        After an error or an interrupt several chunks may wait: all are streamed, and the last summary is returned. A
        single view has no other view to match; only with HPDA does its depth come from the cache. Views may be pushed
        afterwards.
        """
        output = None
        while (chunk := self._live.rest()) is not None:
            output = self._stream(chunk, is_live=True)
        return output

    def _stream(self, chunk: Chunk, *, is_live: bool) -> ChunkOutput:
        """Streams a chunk. The views of a live chunk leave the queue once its step is dispatched."""
        check_chunk(chunk, self.model.config.stream.chunk_size)  # here, because nothing can be raised inside jit
        config, num_tokens = self.model.config, tokens_per_chunk(chunk, self.model.config.network.size_multiple)
        cache = self.cache
        if cache is None:
            cache = _new_cache(config, starting_capacity(config, num_tokens, self.expected_chunks))
        cache = ensure_capacity(cache, config, num_tokens)
        if bool(config.stream.steps_per_chunk) != (self._refine_chunk is not None):
            wanted = "Session(..., refine=online_refinement(model)) with stream.steps_per_chunk above 0, or neither"
            got = f"steps_per_chunk={config.stream.steps_per_chunk} and refine={self._refine_chunk}"
            raise refusal("Session", wanted=wanted, got=got, fix="call online_refinement with the session's model")
        if self._refine_chunk is not None:  # adds the key-view buffers if the cache lacks them
            # After the first masked chunk every key view stores a mask, so this chunk needs one too.
            if chunk.seen is None and cache.key_views is not None and cache.key_views.seen is not None:
                chunk = replace(chunk, seen=jnp.ones(chunk.images.shape[:3], bool))
            is_masked = chunk.seen is not None
            cache = with_refinement(cache, config, *chunk.images.shape[1:3], is_masked=is_masked)
        self.cache = cache
        step, refine = self._program("step", self.model.step, cache, chunk), None
        if self._refine_chunk is not None:
            summary = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), step.out_info[1])
            refine = self._program("refine", self._refine_chunk, cache, chunk, summary)
        # Dispatch every program before blocking on a result. The step consumes the old cache; the new one is stored
        # before the wait, so an interrupt loses nothing.
        self._step_program, self._refine_program = step, refine
        self.cache, out = step(self.params, cache, chunk)
        if is_live:
            self._live.drop(out)
        if refine is not None:
            self.cache = refine(self.params, self.cache, chunk, out)
        check_cache(jax.block_until_ready(self.cache), config)
        return jax.block_until_ready(out)

    def _program(self, name: str, function: Callable, cache: VoxelCache, chunk: Chunk, *more) -> jax.stages.Compiled:
        """`function` compiled for the shapes of `cache`, which it consumes, and of `chunk`."""
        key = _program_key(name, cache, chunk)
        if key not in self._programs:
            since, ahead = time.perf_counter(), self._ahead.pop(key, None)
            new = Kept(function, donate_argnums=(1,))
            self._programs[key] = ahead.result() if ahead else new.program(self.params, cache, chunk, *more)
            self.compile_seconds += time.perf_counter() - since
            self.num_compilations += 1
        return self._programs[key]

    @property
    def stream_frame(self) -> StreamFrame | None:
        """The stream frame of the views pushed, with near and far of the next chunk; None before the first chunk."""
        return self._live.stream_frame

    def gaussians(self) -> Gaussians:
        """The scene so far, in the stream frame: the Gaussians of `model.decode`, then padding rows of opacity 0.

        With `detail`, rows without a Gaussian are skipped; padding rows still follow.
        """
        return self.decode_program()(self.params, self._present_cache())

    def decode_program(self) -> jax.stages.Compiled:
        """The compiled program of `gaussians` for the present cache.

        Only shown pivots are decoded, because a cache has capacity for many more than it holds. Numbers are rounded up
        to powers of two, so that a growing scene rarely compiles.
        """
        cache, config = self._present_cache(), self.model.config
        _, num_shown, num_present = map(int, _count(cache, config))
        num_pivots = min(max(self.least_decoded, power_of_two(num_shown)), cache.confidences.size)
        num_gaussians = None
        if config.additions.detail:
            num_gaussians = max(2 * self.least_decoded, power_of_two(num_present))  # a pivot has about two
        leaves, structure = jax.tree.flatten(cache)
        key = ("decode", num_pivots, num_gaussians, structure, *((leaf.shape, leaf.dtype) for leaf in leaves))
        if key not in self._programs:
            decode = functools.partial(_decode_shown, self.model, num_pivots, num_gaussians)
            self._programs[key] = Kept(decode).program(self.params, cache)
        return self._programs[key]

    def _present_cache(self) -> VoxelCache:
        """The cache, or an empty one before the first chunk. `self.cache` stays None, which `push` asks for."""
        return self.model.init_cache() if self.cache is None else self.cache

    @property
    def step_memory_bytes(self) -> int | None:
        """Memory of the compiled step, by XLA's analysis: arguments, results and temporaries; None if unknown."""
        return _memory_bytes(self._step_program)

    @property
    def refine_memory_bytes(self) -> int | None:
        """Memory of the compiled refinement of a chunk, as `step_memory_bytes`; None without refinement."""
        return _memory_bytes(self._refine_program)

    def cache_facts(self) -> dict[str, int | float]:
        """Occupancy and counters of the cache; `decoded` is the number of Gaussians that are shown."""
        cache = self._present_cache()
        stats = {field.name: int(getattr(cache.stats, field.name)) for field in dataclasses.fields(cache.stats)}
        num_pivots, _, num_gaussians = map(int, _count(cache, self.model.config))
        return {
            "voxels": int(cache.num_voxels),
            "pivots": num_pivots,
            "decoded": num_gaussians,
            "capacity": cache.capacity,
            "overflow": stats["num_dropped"],
            "accepted_fraction": round(stats["num_accepted"] / max(stats["num_seen"], 1), 4),
            **stats,
        }


def _program_key(name: str, cache: VoxelCache, chunk: Chunk) -> tuple:
    """A program by what it computes and by the shapes that may differ within a stream."""
    return name, cache.capacity, chunk.images.shape, chunk.seen is None, chunk.depths is None


_new_cache = Kept(init_cache, static_argnums=(0, 1))


def _decode_shown(
    model: StreamSplat, num_pivots: int, num_gaussians: int | None, params: dict, cache: VoxelCache
) -> Gaussians:
    """The Gaussians of the pivots that are shown, of which there are at most `num_pivots`."""
    pivots = jnp.nonzero(shown_pivots(cache, model.config).reshape(-1), size=num_pivots, fill_value=-1)[0]
    return model.decode_rows(params, cache, pivots, num_gaussians)


@functools.partial(Kept, static_argnums=(1,))
def _count(cache: VoxelCache, config: StreamConfig) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Pivots in use, those of them that are shown, and their Gaussians."""
    num_shown = jnp.sum(shown_pivots(cache, config), dtype=jnp.int32)
    return jnp.sum(cache.counts), num_shown, count_gaussians(cache, config)


def _memory_bytes(program: jax.stages.Compiled | None) -> int | None:
    if program is None or (memory := program.memory_analysis()) is None:
        return None
    held = memory.argument_size_in_bytes + memory.output_size_in_bytes + memory.temp_size_in_bytes
    return held - memory.alias_size_in_bytes  # a donated cache is counted once


def tokens_per_chunk(chunk: Chunk, size_multiple: int) -> int:
    """Number of tokens of one chunk, including those in the padding of its images."""
    v, height, width, _ = chunk.images.shape
    padded = (height + -height % size_multiple) * (width + -width % size_multiple)
    return v * padded // GRID_STRIDE**2


def starting_capacity(config: StreamConfig, num_tokens: int, num_chunks: int = INITIAL_CHUNKS) -> int:
    """Capacity of a new cache: the configured one; under `grow` raised to a power of two that fits the stream.

    Growing compiles the step again, so only long streams should need to grow.
    """
    if config.memory.overflow != "grow":
        return config.memory.capacity
    num_rows = max(INITIAL_CHUNKS * num_tokens, min(int(NEW_SHARE * num_chunks * num_tokens), MOST_ROWS))
    return max(config.memory.capacity, power_of_two(num_rows))


# -- captures ----------------------------------------------------------------------------------------------------------


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
