"""Faults of the frames of a capture: copies, disorder, gaps in the motion, blur, jumps of exposure.

Every finding is a sentence with a remedy. Poses are judged over all frames, images over all frames of a short capture
and over evenly spread pairs of neighbors of a long one, since they must be decoded.
"""

import hashlib
from collections import defaultdict
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64
from PIL import Image
from scipy.ndimage import gaussian_filter

from ssplat_jax.data.capture import Capture

MAX_IMAGES_READ = 64  # decoded to look for blur and jumps of exposure
LONG_SIDE = 640  # pixels of the image in which blur is looked for
THUMBNAIL = (40, 30)  # (width, height) of the image in which neighbors are compared
MIN_CORRELATION = 0.8  # of the thumbnails of neighbors that show the same things
BLUR_RATIO = 0.5  # of a frame's fine detail over its neighbor's, below which it is blurred
EXPOSURE_RATIO = 1.35  # between neighbors
DARK, BRIGHT = 0.05, 0.95  # cells outside are noise or clipped
MIN_FRAMES = 8  # with fewer, disorder is not judged
SHUFFLED_RANK = 0.15  # of the number of frames; median rank of the next camera among the nearest, above which
ASIDE_RATIO = 5.0  # steps to and from a frame over the median step, and over the step from its neighbor to the other
MAX_TURN_SHARE = 0.8  # of the field of view, turned between neighbors, above which they hardly overlap


def frame_warnings(capture: Capture) -> list[str]:
    """Returns the findings about the frames of `capture`, one sentence each.

    Raises:
        InputError: an image that is looked at is damaged.
    """
    return [*copy_warnings(capture), *order_warnings(capture), *turn_warnings(capture), *image_warnings(capture)]


def listed(indices: Sequence[int], num_shown: int = 4) -> str:
    """Returns the first of some frame numbers as text: `3, 8, 9, 20, ...`."""
    return ", ".join(map(str, indices[:num_shown])) + (", ..." if len(indices) > num_shown else "")


def copy_warnings(capture: Capture) -> list[str]:
    """Frames whose image is a copy of an earlier one, byte by byte."""
    of_length: dict[int, list[int]] = defaultdict(list)
    for i, frame in enumerate(capture.frames):
        of_length[0 if frame.path is None else frame.path.stat().st_size].append(i)
    originals: dict[bytes, int] = {}
    copies = []
    for group in of_length.values():
        for i in group if len(group) > 1 else ():
            path = capture.frames[i].path
            data = np.ascontiguousarray(capture.pixels.image(i)).tobytes() if path is None else path.read_bytes()
            if originals.setdefault(hashlib.sha256(data).digest(), i) != i:
                copies.append(i)
    if not copies:
        return []
    return [f"{len(copies)} images are copies of earlier ones (frames {listed(sorted(copies))}): leave them out."]


def order_warnings(capture: Capture) -> list[str]:
    """Frames whose cameras are not in the order of a path."""
    centers = capture.camtoworlds[:, :3, 3]
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=-1)
    if len(capture) < MIN_FRAMES or not (steps > 0).any():
        return []
    rank = float(np.median([_rank(centers, i) for i in range(len(steps))]))
    if rank > max(3.0, SHUFFLED_RANK * len(capture)):
        return [
            f"Frames are not in the order of a path: the next camera is only the {rank:.0f}th nearest of"
            f" {len(capture)}, at the median; name the images in the order of filming."
        ]
    skipping = np.linalg.norm(centers[2:] - centers[:-2], axis=-1)
    least = ASIDE_RATIO * np.maximum(float(np.median(steps[steps > 0])), skipping)
    aside = [int(i) + 1 for i in np.flatnonzero((steps[:-1] > least) & (steps[1:] > least))]
    if not aside:
        return []
    return [
        f"{len(aside)} cameras stand far off the path between their neighbors (frames {listed(aside)}): they are out of"
        " order or their poses are wrong; move them or leave them out."
    ]


def _rank(centers: Float64[np.ndarray, "n 3"], i: int) -> int:
    """Place of the camera after camera `i` among those nearest to it, from 1; ties count for it."""
    distances = np.linalg.norm(centers - centers[i], axis=-1)
    return int(np.sum(distances < distances[i + 1])) - (0 if distances[i + 1] == 0 else 1) + 1


def turn_warnings(capture: Capture) -> list[str]:
    """Turns between neighbors so wide that they hardly overlap, where most neighbors do."""
    axes = capture.camtoworlds[:, :3, 2]
    turns = np.degrees(np.arccos(np.clip(np.sum(axes[1:] * axes[:-1], axis=-1), -1.0, 1.0)))
    K = capture.K(0)
    field = float(np.degrees(2 * np.arctan(max(capture.width / K[0, 0], capture.height / K[1, 1]) / 2)))
    wide = np.flatnonzero(turns > MAX_TURN_SHARE * field)
    if not wide.size or 2 * wide.size > turns.size:
        return []
    count = "1 turn" if wide.size == 1 else f"{wide.size} turns"
    return [
        f"{count} of up to {turns.max():.0f} degrees between neighbors, whose images then hardly overlap"
        f" (after frames {listed(wide.tolist())}): film without gaps, or stream the parts as captures of their own."
    ]


def image_warnings(capture: Capture) -> list[str]:
    """Blurred images and jumps of exposure, among neighbors that show the same things."""
    count = len(capture)
    if count <= MAX_IMAGES_READ:
        firsts = list(range(count - 1))
    else:
        firsts = np.unique(np.linspace(0, count - 2, MAX_IMAGES_READ // 2).round().astype(int)).tolist()
    blurred: set[int] = set()
    jumps: dict[int, float] = {}
    held: dict[int, tuple[np.ndarray, float]] = {}
    for i in firsts:
        held = {k: held[k] if k in held else _measured(capture, k) for k in (i, i + 1)}
        (thumbnail, detail), (next_thumbnail, next_detail) = held[i], held[i + 1]
        if not _is_alike(thumbnail, next_thumbnail):
            continue
        if min(detail, next_detail) < BLUR_RATIO * max(detail, next_detail):
            blurred.add(i if detail < next_detail else i + 1)
        ratio = _exposure_ratio(thumbnail, next_thumbnail)
        if max(ratio, 1 / ratio) > EXPOSURE_RATIO:
            jumps[i] = max(ratio, 1 / ratio)
    looked = "" if count <= MAX_IMAGES_READ else f" of the {2 * len(firsts)} looked at"
    warnings = []
    if blurred:
        frames = listed(sorted(blurred))
        warnings.append(
            f"{len(blurred)} images{looked} are blurred beside their neighbors (frames {frames}): drop them."
        )
    if jumps:
        warnings.append(
            f"{len(jumps)} jumps of exposure of up to {max(jumps.values()):.1f} times between neighbors{looked} (after"
            f" frames {listed(sorted(jumps))}): a run evens out up to 4 times; better lock the exposure while filming."
        )
    return warnings


def _measured(capture: Capture, i: int) -> tuple[np.ndarray, float]:
    """Thumbnail of a frame in gray, and the share of its contrast that is fine detail."""
    gray = Image.fromarray(np.ascontiguousarray(capture.image(i) @ np.array([0.299, 0.587, 0.114], np.float32)))
    shrink = max(1.0, max(gray.size) / LONG_SIDE)
    working = np.asarray(gray.resize((round(gray.width / shrink), round(gray.height / shrink)), Image.Resampling.BOX))
    fine = working - gaussian_filter(working, 1.5)
    detail = float(np.std(fine)) / max(float(np.std(working)), 1e-6)
    return np.asarray(gray.resize(THUMBNAIL, Image.Resampling.BOX), np.float64), detail


def _is_alike(a: np.ndarray, b: np.ndarray) -> bool:
    """True if two thumbnails show the same things."""
    if min(np.std(a), np.std(b)) < 1e-3:
        return False
    return float(np.corrcoef(a.ravel(), b.ravel())[0, 1]) > MIN_CORRELATION


def _exposure_ratio(a: np.ndarray, b: np.ndarray) -> float:
    """Median ratio of two thumbnails where neither is dark or clipped; 1 if that is hardly anywhere."""
    usable = (np.minimum(a, b) > DARK) & (np.maximum(a, b) < BRIGHT)
    return float(np.median(b[usable] / a[usable])) if usable.mean() > 0.2 else 1.0
