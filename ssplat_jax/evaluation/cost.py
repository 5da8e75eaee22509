"""Time from a chunk to a novel view, and peak memory over step, decode and rendering together.

On a CPU the memory is that of the largest program, by XLA's analysis: parameters, cache and inputs, temporaries, and
results that are not written over inputs. On a GPU the allocator counts, from the start of the process.

Every number that is published says where it comes from: `machine`, `commit` and `today`.
"""

import datetime
import functools
import platform
import re
import subprocess
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ssplat_jax.cache.state import ensure_capacity
from ssplat_jax.core import num_cores
from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.chunk import Chunk
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.rasterizer import render
from ssplat_jax.rasterizer.render import capacity_for, render_program
from ssplat_jax.streaming.session import Session, tokens_per_chunk

NUM_CHUNKS = 4  # the last chunks of a stream that an evaluation feeds again to the full cache to time them
NUM_REPEATS = 3  # measurements per chunk
OOM = "OOM"  # stands for the peak memory of what did not fit into the memory of the machine


def measure_latency(session: Session, chunks: list[Chunk], camera: Camera) -> dict:
    """Milliseconds from a chunk to a novel view on the full cache, and of the step and the rendering in it.

    The step takes the same time at every length of a stream; decoding and rendering grow with the scene.

    Everything is compiled before it is timed, and every result is waited for. The session keeps its cache.

    Returns:
        `chunk_ms`, with `median` and `p99`, and the medians `step_ms` and `render_ms`.
    """
    times = []
    cache, config = session.cache, session.model.config
    assert cache is not None  # it has taken in the stream
    # Growing happens a few times in a stream's life and is not part of a chunk's cost.
    grown = ensure_capacity(cache, config, tokens_per_chunk(chunks[0], config.network.size_multiple))
    for chunk in chunks:
        for repeat in range(NUM_REPEATS + 1):
            session.cache = jax.block_until_ready(jax.tree.map(jnp.copy, grown))
            since = time.perf_counter()
            session.feed(chunk)
            jax.block_until_ready(session.cache)
            stepped = time.perf_counter()
            gaussians = jax.block_until_ready(session.gaussians())
            decoded = time.perf_counter()
            jax.block_until_ready(render(gaussians, camera).color)
            done = time.perf_counter()
            if repeat:  # the first may compile the renderer for this number of pairs
                times.append([done - since, stepped - since, done - decoded])
    session.cache = cache
    chunk, step, render_only = (1e3 * np.median(times, axis=0)).round(1).tolist()
    p99 = round(1e3 * float(np.quantile(times, 0.99, axis=0)[0]), 1)
    return {"chunk_ms": {"median": chunk, "p99": p99}, "step_ms": step, "render_ms": render_only}


def peak_memory(session: Session, camera: Camera) -> dict[str, int | str | None]:
    """Memory (`memory_row`) of a session that takes in a chunk, decodes and renders a view; it keeps its cache.

    Args:
        session: a stream that has taken in at least one chunk; `step` is that of the last.
        camera: the view to render, in the stream frame. Its program is compiled once more to be analyzed.
    """
    held = live_bytes((session.params, session.cache))
    gaussians = session.gaussians()
    added, rendering = added_bytes(session.decode_program()), render_bytes(gaussians, camera)
    refine = {"refine": session.refine_memory_bytes} if session.model.config.stream.steps_per_chunk else {}
    return memory_row(
        step=session.step_memory_bytes,
        decode=None if added is None else held + added,
        render=None if rendering is None else held + live_bytes(gaussians) + rendering,
        **refine,
    )


def memory_row(**programs: int | None) -> dict[str, int | str | None]:
    """Columns of a table: the peak, and the bytes in use while each program runs, None where XLA does not tell.

    The peak is that since the process began where the device's allocator counts, else that of the largest program;
    None if one is unknown.
    """
    counters, known = jax.local_devices()[0].memory_stats() or {}, [x for x in programs.values() if x is not None]
    peak = counters.get("peak_bytes_in_use", max(known) if len(known) == len(programs) else None)
    measured_by = "allocator" if "peak_bytes_in_use" in counters else "XLA"
    parts = {f"{name}_bytes": size for name, size in programs.items()}
    return {"peak_memory_bytes": peak, **parts, "measured_by": measured_by}


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
    max_pairs = capacity_for(int(render(gaussians, camera).num_pairs), gaussians.num_gaussians)
    return added_bytes(_render_program(max_pairs, *abstract((gaussians, camera))))


@functools.lru_cache(maxsize=8)  # compiling takes longer than a stream's chunk
def _render_program(max_pairs: int, structure: Any, leaves: tuple) -> jax.stages.Compiled:
    gaussians, camera = structure.unflatten(leaves)
    return render_program(gaussians, camera, max_pairs)


def abstract(arrays: Any) -> tuple[Any, tuple[jax.ShapeDtypeStruct, ...]]:
    """Structure and leaves of a pytree with shapes in place of arrays; both are hashable."""
    leaves, structure = jax.tree.flatten(arrays)
    return structure, tuple(jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in leaves)


# -- where and when a number was measured ------------------------------------------------------------------------------


@functools.cache
def machine() -> str:
    """The device that JAX computes on, its processor's cores, and the version of JAX."""
    device, kind, facts = jax.devices()[0], None, Path("/proc/cpuinfo")
    if device.platform == "cpu" and facts.exists():
        kind = re.search(r"model name\s*: (.*)", facts.read_text())
    name = device.device_kind if device.platform != "cpu" else kind[1] if kind else platform.machine()
    return f"{name}, {num_cores()} cores, jax {jax.__version__}"


@functools.cache
def commit() -> str:
    """The commit of the installed files, with `+` if the repository was changed since; else the package's version."""
    git = functools.partial(subprocess.check_output, cwd=Path(__file__).parent, text=True, stderr=subprocess.DEVNULL)
    try:
        git(["git", "ls-files", "--error-unmatch", "--", Path(__file__).name])  # installed files are in no repository
        return git(["git", "describe", "--always", "--dirty=+", "--abbrev=10", "--exclude=*"]).strip()
    except (OSError, subprocess.CalledProcessError):
        return f"version {version('ssplat-jax')}"


def today() -> str:
    """The date in UTC, as 2026-11-24."""
    return datetime.datetime.now(datetime.UTC).date().isoformat()
