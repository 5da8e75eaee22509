"""Films as H.264 in .mp4, which every browser and player shows, by PyAV (extra `video`)."""

import io
import os
from fractions import Fraction
from typing import Any

import numpy as np
from jaxtyping import UInt8

from ssplat_jax.errors import InputError
from ssplat_jax.storage.atomic import write_atomic

PICTURES_PER_SECOND = 24
BT709 = 1  # the colors that players expect where nothing is said, which is said all the same
QUALITY = "18"  # x264's constant rate factor: no difference from the pictures to be seen


class Film:
    """Pictures of one size, encoded as they come; a file once it is saved.

    Raises:
        InputError: PyAV is not installed.
    """

    def __init__(self, width: int, height: int) -> None:
        av = _av()
        self._encoded, self._frame_of = io.BytesIO(), av.VideoFrame.from_ndarray
        self._container: Any = av.open(self._encoded, "w", format="mp4")
        self._stream = self._container.add_stream("libx264", Fraction(PICTURES_PER_SECOND), options={"crf": QUALITY})
        # Colors are stored for two pixels by two: of odd sides the last pixel is left out.
        self._stream.width, self._stream.height = width // 2 * 2, height // 2 * 2
        self._stream.pix_fmt = "yuv420p"
        self._stream.codec_context.colorspace = BT709
        self._stream.codec_context.color_primaries = BT709
        self._stream.codec_context.color_trc = BT709

    def add(self, picture: UInt8[np.ndarray, "h w 3"]) -> None:
        """The next picture."""
        picture = np.ascontiguousarray(picture[: self._stream.height, : self._stream.width])
        frame = self._frame_of(picture, format="rgb24").reformat(format="yuv420p", dst_colorspace="ITU709")
        self._container.mux(self._stream.encode(frame))

    def save(self, path: str | os.PathLike) -> None:
        """Ends the film and writes it, all or nothing.

        Raises:
            StorageError: the file cannot be written.
        """
        self._container.mux(self._stream.encode())
        self._container.close()
        write_atomic(path, self._encoded.getvalue())


def _av() -> Any:
    try:
        import av
    except ImportError as error:
        raise InputError('film: wanted the package av; run: pip install "ssplat-jax[video]"') from error
    return av
