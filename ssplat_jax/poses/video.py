"""Videos: a first pass that measures sharpness and motion, and a second one that writes the chosen frames as images."""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64
from PIL import Image

from ssplat_jax.core.errors import refusal
from ssplat_jax.poses.frame_choice import MotionMeter, sharpness
from ssplat_jax.poses.photos import save_upright
from ssplat_jax.poses.requirements import require

SMALL_WIDTH = 192  # pixels of the longer side of the images that are measured
FIX = "check that it plays; convert it with `ffmpeg -i INPUT output.mp4`"


@dataclasses.dataclass(frozen=True, eq=False)
class VideoScan:
    """Measurements of the frames of a video, in the order in which they are shown."""

    motion: Float64[np.ndarray, " n"]  # since the first frame, in shares of the width
    sharpnesses: Float64[np.ndarray, " n"]


def count_frames(path: Path) -> int:
    """Number of frames that the header of a video announces, or that its duration suggests; 0 if it tells neither.

    Raises:
        InputError: PyAV is missing, or the file is no readable video.
    """
    with _open(path) as container:
        stream = container.streams.video[0]
        if stream.frames:
            return int(stream.frames)
        seconds = float(stream.duration * stream.time_base) if stream.duration else (container.duration or 0) / 1e6
        return int(seconds * float(stream.average_rate or 0))


def scan_video(path: Path, advance: Callable[[int], None]) -> VideoScan:
    """Measures all frames of a video.

    Args:
        path: the video.
        advance: called with the number of frames so far.

    Raises:
        InputError: the file is no readable video, or has fewer than two frames.
    """
    meter, motion, sharpnesses = MotionMeter(), [], []
    for number, frame in enumerate(_frames(path), start=1):
        gray = _small_gray(frame)
        motion.append(meter.add(gray))
        sharpnesses.append(sharpness(gray))
        advance(number)
    if len(motion) < 2:
        raise refusal(str(path), wanted="a video of a moving camera", got=f"{len(motion)} frames", fix=FIX)
    return VideoScan(np.array(motion), np.array(sharpnesses))


def write_frames(
    path: Path, chosen: Sequence[int], folder: Path, max_side: int, advance: Callable[[int], None]
) -> list[str]:
    """Writes the frames `chosen` of a video as JPEG files, upright, named by their number.

    Args:
        path: the video.
        chosen: numbers of frames, from 0, in order.
        folder: existing folder of the images.
        max_side: longer side of larger images is reduced to so many pixels.
        advance: called with the number of files so far.

    Returns:
        The names of the files.
    """
    wanted, names = set(map(int, chosen)), []
    for number, frame in enumerate(_frames(path)):
        if number in wanted:
            names.append(f"{number:06d}.jpg")
            picture = Image.fromarray(np.rot90(frame.to_ndarray(format="rgb24"), quarter_turns(frame.rotation)))
            save_upright(picture, folder / names[-1], max_side)
            advance(len(names))
            if len(names) == len(wanted):
                break
    return names


def quarter_turns(degrees: int) -> int:
    """Counterclockwise quarter turns that a player applies to frames whose file asks for a rotation by `degrees`."""
    return round(degrees / 90) % 4


def _small_gray(frame: Any) -> Float32[np.ndarray, "h w"]:
    """A frame as a small gray image."""
    scale = min(SMALL_WIDTH / max(frame.width, frame.height), 1.0)
    width, height = (max(round(side * scale), 8) for side in (frame.width, frame.height))
    small = frame.reformat(width=width, height=height, format="gray", interpolation="AREA")
    return small.to_ndarray().astype(np.float32)


def _frames(path: Path) -> Iterator[Any]:
    """The frames of the first video stream, up to the first that is damaged."""
    av = require("av")
    with _open(path) as container:
        container.streams.video[0].thread_type = "AUTO"
        frames = container.decode(container.streams.video[0])
        while True:
            try:
                frame = next(frames, None)
            except av.FFmpegError:  # a recording that was cut off: what came before is of use
                return
            if frame is None:
                return
            yield frame


def _open(path: Path) -> Any:
    """Container of a video file."""
    av = require("av")
    try:
        container = av.open(str(path))
    except (av.FFmpegError, OSError) as error:
        got = f"a file that cannot be decoded ({getattr(error, 'strerror', None) or type(error).__name__})"
        raise refusal(str(path), wanted="a video", got=got, fix=FIX) from None
    if not container.streams.video:
        container.close()
        raise refusal(str(path), wanted="a video", got="a file without pictures", fix=FIX)
    return container
