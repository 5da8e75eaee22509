"""Scenes that several experiments measure, each with its split."""

from pathlib import Path

from ssplat_jax.data.capture import Capture
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.data.split import Split, interleaved_split

REDKITCHEN = "redkitchen"
REDKITCHEN_STRIDE = 5


def open_room(context: int, size: tuple[int, int]) -> tuple[Capture, Split]:
    """`procedural:room` with as many frames as `context` context views need, and its interleaved split."""
    frames = interleaved_split(10_000, 1, context).context[-1] + 1
    capture = open_capture(f"procedural:room?frames={frames}", size=size)
    return capture, interleaved_split(frames, 1, context)


def open_redkitchen(captures: Path, context: int, size: tuple[int, int]) -> tuple[Capture, Split]:
    """The capture redkitchen in the folder `captures`, and its interleaved split.

    Raises:
        InputError: it is not there.
    """
    capture = open_capture(captures / REDKITCHEN, size=size)
    return capture, interleaved_split(len(capture), REDKITCHEN_STRIDE, context)
