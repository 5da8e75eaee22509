"""H.264 video in .mp4 files, which all browsers and players support, encoded with PyAV (extra `video`)."""

import io
import os
from fractions import Fraction
from typing import Any

import numpy as np
from jaxtyping import UInt8

from ssplat_jax.core.atomic import write_atomic
from ssplat_jax.core.errors import InputError

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
