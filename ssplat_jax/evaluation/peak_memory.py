"""Peak memory over step, decode and rendering together, as the paper measures it.

On a CPU it follows from XLA's analysis of each program: the arrays that are live while it runs (parameters, cache and
its inputs), its results that are not written over its inputs, and its temporaries; the largest of the programs counts.
On a GPU the allocator counts, from the start of the process.
"""

import dataclasses
import functools
from typing import Any

import jax

from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.rasterizer import render
from ssplat_jax.rasterizer.render import render_program, round_up
from ssplat_jax.streaming.session import Session


@dataclasses.dataclass(frozen=True)
class PeakMemory:
    """Bytes in use while each program runs; a program whose memory XLA does not tell has None."""

    step: int | None
    decode: int | None
    render: int | None
    refine: int | None = 0
    """Refinement of a chunk; 0 without it."""
    allocator: int | None = None
    """The largest number of bytes in use since the process began, by the allocator of the device; None on a CPU."""

    @property
    def bytes(self) -> int | None:
        """The allocator's peak where there is one, else the largest of the programs; None if one is unknown."""
        if self.allocator is not None:
            return self.allocator
        parts = (self.step, self.decode, self.render, self.refine)
        return None if None in parts else max(part for part in parts if part is not None)

    def to_row(self) -> dict[str, int | str | None]:
        """Columns of a table."""
        return {
            "peak_memory_bytes": self.bytes,
            "step_bytes": self.step,
            "decode_bytes": self.decode,
            "render_bytes": self.render,
            "measured_by": "XLA" if self.allocator is None else "allocator",
        }


def peak_memory(session: Session, camera: Camera) -> PeakMemory:
    """Memory of a session that takes in a chunk, decodes its cache and renders a view.

    The program of rendering is compiled once more to be analyzed. The session keeps its cache.

    Args:
        session: a stream that has taken in at least one chunk; `step` is that of the last.
        camera: the view to render, in the stream frame.

    Returns:
        The bytes of every program.
    """
    held = live_bytes((session.params, session.cache))
    gaussians = session.gaussians()
    return PeakMemory(
        step=session.step_memory_bytes,
        decode=_sum(held, added_bytes(session.decode_program())),
        render=_sum(held, live_bytes(gaussians), render_bytes(gaussians, camera)),
        refine=session.refine_memory_bytes if session.model.config.stream.steps_per_chunk else 0,
        allocator=allocator_peak(),
    )


def live_bytes(arrays: Any) -> int:
    """Bytes of all arrays of a pytree."""
    return sum(leaf.nbytes for leaf in jax.tree.leaves(arrays))


def added_bytes(program: jax.stages.Compiled) -> int | None:
    """Bytes that a program needs beside its inputs: temporaries, and results that are not written over inputs."""
    if (memory := program.memory_analysis()) is None:
        return None
    return memory.temp_size_in_bytes + memory.output_size_in_bytes - memory.alias_size_in_bytes


def render_bytes(gaussians: Gaussians, camera: Camera) -> int | None:
    """Bytes that rendering a view needs beside the Gaussians, with the capacity for pairs that `render` chooses."""
    num_pairs = round_up(int(render(gaussians, camera).num_pairs))
    return added_bytes(_render_program(num_pairs, *abstract((gaussians, camera))))


@functools.lru_cache(maxsize=8)
def _render_program(max_pairs: int, structure: Any, leaves: tuple) -> jax.stages.Compiled:
    """`render_program` for shapes of Gaussians and camera; kept, since compiling takes longer than a stream's chunk."""
    gaussians, camera = structure.unflatten(leaves)
    return render_program(gaussians, camera, max_pairs)


def abstract(arrays: Any) -> tuple[Any, tuple[jax.ShapeDtypeStruct, ...]]:
    """Structure and leaves of a pytree with shapes in place of arrays; both are hashable."""
    leaves, structure = jax.tree.flatten(arrays)
    return structure, tuple(jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in leaves)


def allocator_peak() -> int | None:
    """The most bytes in use since the process began, by the device's allocator; None where it does not count."""
    counters = jax.local_devices()[0].memory_stats()
    return None if counters is None else counters.get("peak_bytes_in_use")


def _sum(*parts: int | None) -> int | None:
    return None if None in parts else sum(part for part in parts if part is not None)
