"""Live streams: views that wait for their chunk, and near and far that move as views come.

Near, far and scale of a causal stream come from its first chunk. A later chunk contradicts near or far where more than
`MAX_END_SHARE` of its confident cells lie in the last `END_SHARE` of the range, counted in inverse depth: the surface
may lie beyond that end, which then moves outward by `STEP` for the chunks that follow, until far / near is `MAX_RANGE`.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float32

from ssplat_jax.config import StreamConfig
from ssplat_jax.core.cameras import check_matrices
from ssplat_jax.core.chunk import Chunk, check_images
from ssplat_jax.core.errors import echo, refusal
from ssplat_jax.data.capture import MAX_SIDE, ArrayPixels, Capture
from ssplat_jax.data.depth_range import MAX_RANGE
from ssplat_jax.data.posed_image import Frame, check_camtoworld, check_intrinsics, invert_pose
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.model.streamsplat import ChunkOutput

END_SHARE = 1 / 32  # share of the range of inverse depths that counts as its end
MAX_END_SHARE = 0.2  # share of the confident cells of a chunk that may lie at an end
STEP = 1.5  # factor by which an end moves
MIN_CELLS = 64  # confident cells below which a chunk contradicts nothing


def widen_range(stream_frame: StreamFrame, output: ChunkOutput, config: StreamConfig) -> StreamFrame:
    """The stream frame for the chunks after one, with near and far moved outward where that chunk contradicts them.

    Args:
        stream_frame: the frame in which the chunk was streamed.
        output: what the step gave for the chunk.
        config: configuration of the model; cells below `min_confidence` have no say.
    """
    confidences = np.asarray(output.confidences)
    is_counted = (confidences > 0) & (confidences >= config.memory.min_confidence)
    inverse = 1.0 / np.asarray(output.depths, np.float64)[is_counted]
    if inverse.size < MIN_CELLS:
        return stream_frame
    least, most = 1.0 / stream_frame.far, 1.0 / stream_frame.near
    margin = END_SHARE * (most - least)
    near, far = stream_frame.near, stream_frame.far
    if np.mean(inverse >= most - margin) > MAX_END_SHARE:
        near = min(near, max(near / STEP, far / MAX_RANGE))
    if np.mean(inverse <= least + margin) > MAX_END_SHARE:
        far = max(far, min(far * STEP, near * MAX_RANGE))
    # The scale stays, because the cache is in its units; the chunk itself is not streamed again.
    return dataclasses.replace(stream_frame, near=near, far=far)


class LiveViews:
    """Views that wait for their chunk, and the stream frame that the first chunk gave.

    Args:
        config: configuration of the model.
        stream_frame: stream frame of the cache that is continued; by default the first chunk's.
    """

    def __init__(self, config: StreamConfig, stream_frame: StreamFrame | None = None) -> None:
        self._config = config.replace(causal=True)
        # The frame, and the output of the last chunk if the frame has not learned from it yet. They are replaced
        # together, because an interrupt may come between two statements.
        self._learned: tuple[StreamFrame | None, ChunkOutput | None] = stream_frame, None
        # Frame, image, mask and depth map of each; a map without a known depth stands for none.
        self._waiting: list[tuple[Frame, Float32[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"], np.ndarray]] = []
        self._num_views = 0
        self._size: tuple[int, int] | None = None

    def add(self, image: object, K: object, viewmat: object, seen: object = None, depth: object = None) -> Chunk | None:
        """Takes a view as `Session.push` does, and gives the chunk that it completes; None while views are missing.

        Raises:
            InputError: a value cannot be used, or the image has another size than the first.
        """
        pixels = _checked_image(image)
        height, width, _ = pixels.shape
        if self._size not in (None, (width, height)):
            got, size = f"{width}x{height}", "x".join(map(str, self._size or ()))
            raise refusal("push: image", wanted=f"{size} as the first", got=got, fix="start a session per size")
        camtoworld = invert_pose(check_camtoworld(np.asarray(viewmat).tolist(), "push: viewmat")[0])
        mask = np.ones((height, width), bool) if seen is None else np.asarray(seen)
        if mask.shape != (height, width) or mask.dtype != bool:
            got, fix = f"{mask.dtype} {list(mask.shape)}", "give True where a pixel counts"
            raise refusal("push: seen", wanted=f"bool [{height}, {width}]", got=got, fix=fix)
        measured = np.zeros((height, width), np.float32) if depth is None else np.asarray(depth)
        if measured.shape != (height, width) or not np.issubdtype(measured.dtype, np.floating):
            got, fix = f"{measured.dtype} {list(measured.shape)}", "give camera z in the unit of the poses"
            raise refusal("push: depth", wanted=f"floats [{height}, {width}]", got=got, fix=fix)
        matrix = np.asarray(K, np.float64)
        if matrix.shape != (3, 3):
            raise refusal("push: K", wanted="a 3x3 matrix", got=echo(matrix.tolist()), fix="give intrinsics in pixels")
        check_matrices(np.eye(4), matrix, "push", complete=True)
        (fx, _, cx), (_, fy, cy) = matrix[:2].tolist()
        camera = check_intrinsics(fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height, where="push: K")
        frame = Frame(str(self._num_views), camtoworld, camera, width, height, is_masked=not mask.all())
        self._size = (width, height)
        self._waiting.append((frame, pixels, mask, measured.astype(np.float32)))
        self._num_views += 1
        return self.rest() if len(self._waiting) >= self._config.stream.chunk_size else None

    def rest(self) -> Chunk | None:
        """The next chunk of the views that wait, padded with invalid views; None if there are none.

        The views wait on until `drop` is called.
        """
        if not self._waiting:
            return None
        frames, images, masks, depths = zip(*self._waiting[: self._config.stream.chunk_size], strict=True)
        pixels = ArrayPixels(images=np.stack(images), depths=np.stack(depths), masks=np.stack(masks))
        facts = {"width": frames[0].width, "height": frames[0].height, "streams_depth": bool(np.any(pixels.depths > 0))}
        capture = Capture(name="live", format="memory", frames=frames, pixels=pixels, **facts)
        if self.stream_frame is None:
            self._learned = capture.stream_frame(self._config), None
        return next(iter(capture.chunks(self._config, range(len(capture)), stream_frame=self.stream_frame)))

    def drop(self, output: ChunkOutput) -> None:
        """Forgets the views of the chunk that `rest` gave last, which is streamed with that output."""
        size = self._config.stream.chunk_size
        self._waiting, self._learned = self._waiting[size:], (self.stream_frame, output)

    @property
    def stream_frame(self) -> StreamFrame | None:
        """The frame of the next chunk; None before the first.

        Computed when it is needed, since the step of the last chunk may still run.
        """
        stream_frame, output = self._learned
        if stream_frame is not None and output is not None:
            self._learned = widen_range(stream_frame, output, self._config), None
        return self._learned[0]


def _checked_image(image: object) -> Float32[np.ndarray, "h w 3"]:
    """An image as float32 in [0, 1]."""
    pixels = np.asarray(image)
    if pixels.ndim != 3 or pixels.shape[2] != 3 or not all(1 <= side <= MAX_SIDE for side in pixels.shape[:2]):
        got = echo(list(pixels.shape))
        raise refusal("push: image", wanted="height x width x 3", got=got, fix="give an RGB image")
    if pixels.dtype == np.uint8:
        return pixels.astype(np.float32) / np.float32(255)
    check_images(pixels, "push: image")
    return pixels.astype(np.float32).clip(0, 1)
