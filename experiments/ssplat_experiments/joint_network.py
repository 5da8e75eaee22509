"""The same network over all views at once: the fixed-view method with which the paper compares a stream."""

import functools
from typing import Any

import jax
import jax.numpy as jnp

from ssplat_jax.cache import init_cache
from ssplat_jax.config import StreamConfig
from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.chunk import Chunk
from ssplat_jax.core.gaussians import Gaussians, mask_gaussians
from ssplat_jax.evaluation.cost import (
    PeakMemory,
    abstract,
    added_bytes,
    allocator_peak,
    live_bytes,
    render_bytes,
)
from ssplat_jax.model.streamsplat import StreamSplat

SMALLEST_CAPACITY = 128


def joint_config(config: StreamConfig, num_views: int) -> StreamConfig:
    """`config` with all views in one chunk and nothing that reads a memory."""
    changes = {"chunk_size": num_views, "hpda": False, "cgfi": False, "carving": False}
    return config.replace(**changes, capacity=SMALLEST_CAPACITY)


class JointNetwork:
    """The network for a number of views, all of which are matched, mixed and decoded together.

    Args:
        config: configuration of the stream that it is compared with.
        params: the parameters of that stream.
        chunk: all views, as one chunk.
    """

    def __init__(self, config: StreamConfig, params: dict, chunk: Chunk) -> None:
        self.params, self.chunk = params, chunk
        self.program = _program(joint_config(config, len(chunk.images)), *abstract((params, chunk)))

    def gaussians(self) -> Gaussians:
        """The scene of all views, in the stream frame."""
        return jax.block_until_ready(self.program(self.params, self.chunk))

    def network_bytes(self) -> int | None:
        """Bytes in use while the network runs."""
        added = added_bytes(self.program)
        return None if added is None else added + live_bytes((self.params, self.chunk))

    def peak_memory(self, camera: Camera) -> PeakMemory:
        """Memory of running the network, which decodes within, and of rendering a view."""
        gaussians = self.gaussians()
        rendering = render_bytes(gaussians, camera)
        held = live_bytes((self.params, gaussians))
        return PeakMemory(
            step=(network := self.network_bytes()),
            decode=network,
            render=None if rendering is None else held + rendering,
            allocator=allocator_peak(),
        )


def forget() -> None:
    """Keeps no programs any longer."""
    _program.cache_clear()


@functools.lru_cache(maxsize=4)
def _program(config: StreamConfig, structure: Any, leaves: tuple) -> jax.stages.Compiled:
    """The compiled network for the shapes of its parameters and views."""
    model = StreamSplat(config)

    def decode_all(params: dict, chunk: Chunk) -> Gaussians:
        tokens = model.predict(params, init_cache(config), chunk).tokens
        accepted = tokens.valid & (tokens.confidences >= config.memory.min_confidence)
        return mask_gaussians(model.decode_tokens(params, tokens), model.repeat_per_gaussian(accepted))

    return jax.jit(decode_all).lower(*structure.unflatten(leaves)).compile()


def one_chunk(chunks: list[Chunk]) -> Chunk:
    """All valid views of a list of chunks as one chunk."""
    joined = jax.tree.map(lambda *parts: jnp.concatenate(parts) if parts[0].ndim else parts[0], *chunks)
    keep = jnp.nonzero(joined.valid)[0]
    return jax.tree.map(lambda x: x[keep] if x.ndim else x, joined)
