"""`LiveViews`: views of a live source, collected into chunks in the order in which they come."""

import numpy as np
from jaxtyping import Float32, Float64

from ssplat_jax.config import StreamConfig
from ssplat_jax.core.chunk import Chunk
from ssplat_jax.core.errors import echo, refusal
from ssplat_jax.data.capture import MAX_SIDE, Capture
from ssplat_jax.data.images import ArrayPixels
from ssplat_jax.data.posed_image import Frame, check_camtoworld, check_intrinsics, invert_pose
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.model.streamsplat import ChunkOutput
from ssplat_jax.streaming.causal_range import widen_range

WHERE = "push"
"""Start of the messages about a view."""


class LiveViews:
    """Views that wait for their chunk, and the stream frame that the first chunk gave.

    Args:
        config: configuration of the model.
        frame: stream frame of the cache that is continued; by default the first chunk's.
    """

    def __init__(self, config: StreamConfig, frame: StreamFrame | None = None) -> None:
        self._config = config.replace(causal=True)
        # The frame, and the output of the last chunk if the frame has not learned from it yet; replaced together.
        self._learned: tuple[StreamFrame | None, ChunkOutput | None] = frame, None
        self._images: list[Float32[np.ndarray, "h w 3"]] = []
        self._frames: list[Frame] = []
        self._num_views = 0
        self._size: tuple[int, int] | None = None

    def add(self, image: object, K: object, viewmat: object) -> Chunk | None:
        """Takes a view, and gives the chunk that it completes.

        Args:
            image: RGB, height x width x 3, as float in [0, 1] or as uint8.
            K: 3x3 intrinsics, pixels; the center of the first pixel is (0.5, 0.5).
            viewmat: 4x4 world-to-camera transform with OpenCV axes, in any world of one scale.

        Returns:
            The chunk in the stream frame, or None while views are missing.

        Raises:
            InputError: a value cannot be used, or the image has another size than the first.
        """
        pixels = _checked_image(image)
        height, width, _ = pixels.shape
        if self._size not in (None, (width, height)):
            got, size = f"{width}x{height}", "x".join(map(str, self._size or ()))
            raise refusal(f"{WHERE}: image", wanted=f"{size} as the first", got=got, fix="start a session per size")
        frame = Frame(str(self._num_views), _checked_pose(viewmat), _checked_K(K, width, height), width, height)
        self._size = (width, height)
        self._images.append(pixels)
        self._frames.append(frame)
        self._num_views += 1
        return self.rest() if len(self._frames) >= self._config.stream.chunk_size else None

    def rest(self) -> Chunk | None:
        """The next chunk of the views that wait, padded with invalid views; None if there are none.

        The views wait on until `drop` is called.
        """
        if not self._frames:
            return None
        size = self._config.stream.chunk_size
        images = np.stack(self._images[:size])
        height, width = images.shape[1:3]
        depths = np.zeros(images.shape[:3], np.float32)
        frames, pixels = tuple(self._frames[:size]), ArrayPixels(images=images, depths=depths)
        capture = Capture(name="live", format="memory", frames=frames, pixels=pixels, width=width, height=height)
        if self.frame is None:
            self._learned = capture.stream_frame(self._config), None
        return next(iter(capture.chunks(self._config, range(len(capture)), frame=self.frame)))

    def drop(self, output: ChunkOutput) -> None:
        """Forgets the views of the chunk that `rest` gave last, which is streamed with that output."""
        size = self._config.stream.chunk_size
        self._images, self._frames, self._learned = self._images[size:], self._frames[size:], (self.frame, output)

    @property
    def frame(self) -> StreamFrame | None:
        """The frame of the next chunk: near and far moved outward where the last one contradicts them (`causal_range`).

        Computed when it is needed, since the step of the last chunk may still run; None before the first chunk.
        """
        frame, output = self._learned
        if frame is not None and output is not None:
            self._learned = widen_range(frame, output, self._config), None
        return self._learned[0]


def _checked_image(image: object) -> Float32[np.ndarray, "h w 3"]:
    """An image as float32 in [0, 1]."""
    pixels = np.asarray(image)
    if pixels.ndim != 3 or pixels.shape[2] != 3 or not all(1 <= side <= MAX_SIDE for side in pixels.shape[:2]):
        fix = "give an RGB image"
        raise refusal(f"{WHERE}: image", wanted="height x width x 3", got=echo(list(pixels.shape)), fix=fix)
    if pixels.dtype == np.uint8:
        return pixels.astype(np.float32) / np.float32(255)
    is_float = np.issubdtype(pixels.dtype, np.floating)
    if not (is_float and np.isfinite(pixels).all() and pixels.min() >= 0 and pixels.max() <= 1):
        got = f"{pixels.dtype} from {pixels.min()} to {pixels.max()}"
        raise refusal(f"{WHERE}: image", wanted="floats in [0, 1], or uint8", got=got, fix="scale the image")
    return pixels.astype(np.float32)


def _checked_pose(viewmat: object) -> Float64[np.ndarray, "4 4"]:
    """The camera-to-world pose of a world-to-camera transform."""
    return invert_pose(check_camtoworld(np.asarray(viewmat).tolist(), f"{WHERE}: viewmat")[0])


def _checked_K(K: object, width: int, height: int) -> Float64[np.ndarray, "3 3"]:
    """Intrinsics of an image of that size."""
    matrix = np.asarray(K, np.float64)
    is_pinhole = matrix.shape == (3, 3) and np.allclose(matrix[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]], [0, 0, 0, 0, 1])
    if not is_pinhole:
        fix = "give a 3x3 matrix without skew"
        raise refusal(f"{WHERE}: K", wanted="[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]", got=echo(matrix.tolist()), fix=fix)
    (fx, _, cx), (_, fy, cy) = matrix[:2].tolist()
    return check_intrinsics(fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height, where=f"{WHERE}: K")
