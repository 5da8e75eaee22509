"""Choice of frames from a video: at equal distances of image motion, and the sharpest frame around each of them.

Images of this module are small and gray, in [0, 255]. Motion is measured in shares of the image's width: how far the
picture has moved since the first frame, as a sum of block displacements. It grows while the camera turns or moves, and
stays where it is while the camera stands still.
"""

import numpy as np
from jaxtyping import Float32, Float64, Int64

STEP = 0.05  # of the image's width: motion between two chosen frames, if the number of frames allows
MIN_FRAMES = 20  # chosen even if the picture moves less than so many steps
BLOCK = 48  # pixels: side of the blocks that are followed
MIN_CONTRAST = 2.0  # gray levels (standard deviation) below which a block shows nothing to follow
KEY_SHIFT = 6.0  # pixels of motion after which the frame that motion is measured against is replaced


def sharpness(gray: Float32[np.ndarray, "h w"]) -> float:
    """Mean squared Laplacian of an image; comparable between frames that show the same things."""
    laplacian = 4 * gray[1:-1, 1:-1] - gray[:-2, 1:-1] - gray[2:, 1:-1] - gray[1:-1, :-2] - gray[1:-1, 2:]
    return float(np.mean(np.square(laplacian)))


def displacement(before: Float32[np.ndarray, "h w"], after: Float32[np.ndarray, "h w"]) -> float:
    """Median displacement of the blocks of an image, in pixels, by phase correlation.

    Limits:
        Whole pixels, of up to half a block; blocks without contrast are left out, and without any block it is 0.
    """
    height, width = (side // BLOCK * BLOCK for side in before.shape)
    if not height or not width:
        return 0.0
    blocks = np.stack([_blocks(image[:height, :width]) for image in (before, after)])
    blocks = blocks[:, (blocks.std(axis=(2, 3)) > MIN_CONTRAST).all(axis=0)]
    if not blocks.shape[1]:
        return 0.0
    window = np.outer(np.hanning(BLOCK), np.hanning(BLOCK))
    spectra = np.fft.rfft2((blocks - blocks.mean(axis=(2, 3), keepdims=True)) * window)
    cross = spectra[1] * np.conj(spectra[0])
    peaks = np.fft.irfft2(cross / np.maximum(np.abs(cross), 1e-9), s=(BLOCK, BLOCK)).reshape(len(cross), -1).argmax(-1)
    shifts = np.stack(np.unravel_index(peaks, (BLOCK, BLOCK)), axis=-1)
    shifts = (shifts + BLOCK // 2) % BLOCK - BLOCK // 2
    return float(np.median(np.linalg.norm(shifts, axis=-1)))


def _blocks(image: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "n b b"]:
    """The square blocks of an image, whose sides are multiples of `BLOCK`."""
    rows, columns = (side // BLOCK for side in image.shape)
    return image.reshape(rows, BLOCK, columns, BLOCK).swapaxes(1, 2).reshape(-1, BLOCK, BLOCK)


class MotionMeter:
    """Motion since the first frame, in shares of the width, frame by frame; it never decreases.

    Each frame is compared with a key frame, which is replaced when the picture has moved by `KEY_SHIFT` pixels. So slow
    motion is not lost in rounding, and noise of a still picture does not add up.
    """

    def __init__(self) -> None:
        self._key: Float32[np.ndarray, "h w"] | None = None
        self._at_key = self._reached = 0.0

    def add(self, gray: Float32[np.ndarray, "h w"]) -> float:
        """Returns the motion at the next frame."""
        if self._key is None:
            self._key = gray
        shift = displacement(self._key, gray)
        self._reached = max(self._reached, self._at_key + shift / gray.shape[1])
        if shift >= KEY_SHIFT:
            self._key, self._at_key = gray, self._reached
        return self._reached


def choose_frames(
    motion: Float64[np.ndarray, " n"], sharpnesses: Float64[np.ndarray, " n"], max_frames: int
) -> Int64[np.ndarray, " k"]:
    """Returns the chosen frames of a video, in order.

    The motion of the video is divided into equal steps of at least `STEP`, at most `max_frames` of them. Around each
    step the sharpest frame is taken that is off by a quarter of a step at most, so two chosen frames are half a step to
    one and a half steps apart; where the picture jumps farther, the nearest frame is taken.

    Args:
        motion: motion at each frame, not decreasing, in shares of the width (`MotionMeter`).
        sharpnesses: `sharpness` of each frame.
        max_frames: upper bound of the number of chosen frames.
    """
    count = int(np.clip(motion[-1] / STEP + 1, MIN_FRAMES, max(max_frames, 2)))
    if count >= len(motion):
        return np.arange(len(motion))
    spacing = motion[-1] / (count - 1)
    if spacing == 0:  # nothing moves
        return np.array([int(np.argmax(sharpnesses))])
    chosen = set()
    for at in np.linspace(0, motion[-1], count):
        around = np.flatnonzero(np.abs(motion - at) <= spacing / 4)
        best = around[np.argmax(sharpnesses[around])] if len(around) else np.argmin(np.abs(motion - at))
        chosen.add(int(best))
    return np.array(sorted(chosen))
