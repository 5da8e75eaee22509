"""Picture files: images, comparisons with a target, and H.264 videos, which all browsers and players support."""

import io
import os
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from ssplat_jax.core.atomic import write_atomic
from ssplat_jax.core.errors import InputError
from ssplat_jax.core.false_colors import color_depth, eight_bits


def save_image(path: Path, image: Float[np.ndarray, "h w 3"]) -> None:
    """Writes an image in [0, 1] as an 8-bit file in the format of the suffix.

    Raises:
        StorageError: the file cannot be written.
    """
    encoded = io.BytesIO()
    Image.fromarray(eight_bits(image)).save(encoded, Image.registered_extensions()[path.suffix.lower()])
    write_atomic(path, encoded.getvalue())


def save_comparison(
    path: Path,
    target: Float[np.ndarray, "h w 3"],
    color: Float[np.ndarray, "h w 3"],
    depth: Float[np.ndarray, "h w"],
    depth_range: tuple[float, float],
) -> None:
    """Writes target | render | depth side by side.

    Args:
        path: file to write; its suffix names the format.
        target: image in [0, 1].
        color: render in [0, 1].
        depth: depth of the render, 0 where nothing is.
        depth_range: nearest and farthest depth of the color scale, in the units of `depth`.

    Raises:
        StorageError: the file cannot be written.
    """
    save_image(path, np.concatenate([target, color, color_depth(depth, *depth_range)], axis=1))


def evenly_spread(count: int, most: int) -> list[int]:
    """At most `most` places among `count`, evenly spread, the first and the last included."""
    if count <= most:
        return list(range(count))
    return [round(k * (count - 1) / (most - 1)) for k in range(most)]


# -- video -------------------------------------------------------------------------------------------------------------


FRAMES_PER_SECOND = 24
BT709 = 1  # color space; players assume it when a file names none, and ours names it
QUALITY = "18"  # x264's constant rate factor: visually lossless


class VideoWriter:
    """Encoder of a video of fixed size: frames are encoded as they are added, and `save` writes the file.

    Raises:
        InputError: PyAV is not installed.
    """

    def __init__(self, width: int, height: int) -> None:
        try:
            import av
        except ImportError as error:
            raise InputError(
                'video: wanted the package av, which is not installed; run: pip install -e ".[video]"'
            ) from error
        self._encoded, self._frame_of = io.BytesIO(), av.VideoFrame.from_ndarray
        self._container: Any = av.open(self._encoded, "w", format="mp4")
        self._stream = self._container.add_stream("libx264", Fraction(FRAMES_PER_SECOND), options={"crf": QUALITY})
        # Chroma is stored per 2x2 pixels, so the last pixel of an odd side is cropped.
        self._stream.width, self._stream.height = width // 2 * 2, height // 2 * 2
        self._stream.pix_fmt = "yuv420p"
        context = self._stream.codec_context
        context.colorspace = context.color_primaries = context.color_trc = BT709

    def add(self, image: UInt8[np.ndarray, "h w 3"]) -> None:
        """Appends one RGB frame."""
        image = np.ascontiguousarray(image[: self._stream.height, : self._stream.width])
        frame = self._frame_of(image, format="rgb24").reformat(format="yuv420p", dst_colorspace="ITU709")
        self._container.mux(self._stream.encode(frame))

    def save(self, path: str | os.PathLike) -> None:
        """Finishes the video and writes it to `path` atomically.

        Raises:
            StorageError: the file cannot be written.
        """
        self._container.mux(self._stream.encode())
        self._container.close()
        write_atomic(path, self._encoded.getvalue())
