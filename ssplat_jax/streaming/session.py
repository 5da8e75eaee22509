"""`Session`: a stream on the host. It holds the cache, makes room, compiles once per shape, and counts."""

import time

import jax
import jax.numpy as jnp

from ssplat_jax.cache import VoxelCache, check_cache, ensure_room
from ssplat_jax.cache.state import init_cache
from ssplat_jax.chunk import Chunk
from ssplat_jax.config import StreamConfig
from ssplat_jax.gaussians import Gaussians
from ssplat_jax.model import GRID_STRIDE
from ssplat_jax.streaming.streamsplat import ChunkOutput, StreamSplat, shown_pivots

ROOM_AT_START = 4
"""A new cache holds this many chunks of tokens that all open voxels of their own: few captures make it grow."""

FEWEST_DECODED = 1 << 15
"""Pivots that are decoded at least: below, a growing scene would compile more than it saves."""


class Session:
    """One stream of one image size.

    Args:
        model: what to run.
        params: its parameters.
        cache: continue from this one; by default an empty cache with room for some chunks.
    """

    def __init__(self, model: StreamSplat, params: dict, cache: VoxelCache | None = None) -> None:
        self.model, self.params, self.cache = model, params, cache
        self.compile_seconds = 0.0
        self.num_compilations = 0
        self._programs: dict[tuple, jax.stages.Compiled] = {}
        self._count_shown = jax.jit(lambda cache: jnp.sum(shown_pivots(cache, model.config), dtype=jnp.int32))
        self._decode_shown = jax.jit(model.decode_shown, static_argnums=2)
        self._last_program: jax.stages.Compiled | None = None

    def feed(self, chunk: Chunk) -> ChunkOutput:
        """Streams one chunk into the cache; returns when it is done.

        Raises:
            CacheError: tokens were lost although the overflow policy promises to keep them.
        """
        config, num_tokens = self.model.config, tokens_per_chunk(chunk, self.model.config.network.size_multiple)
        if self.cache is None:
            self.cache = init_cache(config, starting_capacity(config, num_tokens))
        self.cache = ensure_room(self.cache, config, num_tokens)
        step = self._program(chunk)
        self.cache, out = jax.block_until_ready(step(self.params, self.cache, chunk))
        check_cache(self.cache, config)
        return out

    def gaussians(self) -> Gaussians:
        """The scene so far, in the stream frame: what `model.decode` shows; rows of opacity 0, all last, are absent.

        A cache has room for many more pivots than it holds, and decoding and rendering cost what their rows cost. The
        number of pivots decoded is a power of two, so that few programs are compiled.
        """
        if self.cache is None:
            self.cache = self.model.init_cache()
        num_shown = int(self._count_shown(self.cache))
        num_pivots = min(max(FEWEST_DECODED, 1 << max(num_shown - 1, 0).bit_length()), self.cache.alive.size)
        return self._decode_shown(self.params, self.cache, num_pivots)

    @property
    def step_memory_bytes(self) -> int | None:
        """What the compiled step needs, arguments, results and temporaries together, by XLA's own analysis."""
        if self._last_program is None or (memory := self._last_program.memory_analysis()) is None:
            return None
        return (
            memory.argument_size_in_bytes
            + memory.output_size_in_bytes
            + memory.temp_size_in_bytes
            - memory.alias_size_in_bytes
        )

    def _program(self, chunk: Chunk) -> jax.stages.Compiled:
        assert self.cache is not None
        key = (self.cache.capacity, chunk.images.shape)
        if key not in self._programs:
            since = time.perf_counter()
            step = jax.jit(self.model.step, donate_argnums=1)
            self._programs[key] = step.lower(self.params, self.cache, chunk).compile()
            self.compile_seconds += time.perf_counter() - since
            self.num_compilations += 1
        self._last_program = self._programs[key]
        return self._last_program


def tokens_per_chunk(chunk: Chunk, size_multiple: int) -> int:
    """Tokens of one chunk, those of the padding included."""
    v, height, width, _ = chunk.images.shape
    padded = (height + -height % size_multiple) * (width + -width % size_multiple)
    return v * padded // GRID_STRIDE**2


def starting_capacity(config: StreamConfig, num_tokens: int) -> int:
    """The configured capacity; if it may grow, at least the power of two that holds the first chunks in any case."""
    if config.memory.overflow != "grow":
        return config.memory.capacity
    return max(config.memory.capacity, 1 << (ROOM_AT_START * num_tokens - 1).bit_length())
