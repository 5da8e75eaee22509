"""Scenes that several experiments stream, and sessions that share their compiled programs."""

import functools
from pathlib import Path

import jax

from ssplat_experiments import baselines
from ssplat_jax.config import StreamConfig
from ssplat_jax.core import cpu_backend
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.data.split import Split, interleaved_split
from ssplat_jax.model.network import complete_params
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.refinement import online_refinement
from ssplat_jax.storage.weights import load_params
from ssplat_jax.streaming.session import INITIAL_CHUNKS, Session

REDKITCHEN, REDKITCHEN_STRIDE = "redkitchen", 5

START_CAPACITY = 128  # caches start as small as they can and double when needed, so that memory is what a scene needs
MAX_KEPT = 4  # configurations whose programs are kept; the one that was used longest ago goes first


def open_room(context: int, size: tuple[int, int]) -> tuple[Capture, Split]:
    """`procedural:room` with as many frames as `context` context views need, and its interleaved split."""
    frames = interleaved_split(10_000, 1, context).context[-1] + 1
    capture = open_capture(f"procedural:room?frames={frames}", size=size)
    return capture, interleaved_split(frames, 1, context)


def open_redkitchen(captures: Path, context: int, size: tuple[int, int]) -> tuple[Capture, Split]:
    """The capture redkitchen in the folder `captures`, without its depth maps, and its interleaved split.

    Raises:
        InputError: it is not there.
    """
    capture = open_capture(f"{captures / REDKITCHEN}?depth=off", size=size)
    return capture, interleaved_split(len(capture), REDKITCHEN_STRIDE, context)


def new_session(config: StreamConfig) -> Session:
    """A session with an empty cache and the shipped weights, whose programs may be compiled already.

    Stages that the shipped weights lack are untrained. Two streams of one configuration must not be fed in turns: they
    are the same object.
    """
    session = _session(config)
    session.cache, session.expected_chunks = None, INITIAL_CHUNKS
    return session


@functools.lru_cache(maxsize=MAX_KEPT)
def _session(config: StreamConfig) -> Session:
    model = StreamSplat(config)
    params = complete_params(jax.random.key(0), config, load_params("tiny"))
    return Session(model, params, refine=online_refinement(model))


def make_room() -> None:
    """Drops compiled programs, of kept sessions too, before the process holds more than Linux lets it map."""
    cpu_backend.make_room(_session.cache_clear, baselines.program.cache_clear)
