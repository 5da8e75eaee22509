"""Summary of a capture for `ssplat inspect`: facts, the scale and depth range of a run, and warnings with remedies.

Warnings about frames tell of copies, disorder, gaps in the motion, blur and jumps of exposure. Poses are looked at in
all frames; images, which must be decoded, in all frames of a short capture and in evenly spread pairs of a long one.
"""

import hashlib
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64
from PIL import Image
from scipy.ndimage import gaussian_filter

from ssplat_jax.config import StreamConfig
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.depth_range import DepthStatistics, estimate_depths, same_place_distance, stream_scale
from ssplat_jax.data.pose_check import fit_poses, pose_warning
from ssplat_jax.data.sparse_matches import gray_image, keypoints_of

LOW_STEP = 0.012  # step between frames over median depth, below which four consecutive frames have little parallax
GOOD_STEP = 0.03  # step over median depth that a suggested stride aims at
HIGH_STEP = 0.6  # step over median depth, above which neighboring frames hardly overlap
MAX_FOCAL_RATIO = 4.0  # largest over smallest focal length; above it there is a warning
JUMP_RATIO = 20.0  # step over median step, above which there is a warning
LOW_PARALLAX_DEGREES = 2.0  # median over the points, below which depth is uncertain
MAX_DEPTH_RATIO = 1.5  # median of the depth maps over that of the matches, or its inverse; above it there is a warning
NUM_DEPTH_MAPS_READ = 8  # evenly spread; a median needs no more
MAX_IMAGES_READ = 64  # decoded to look for blur and jumps of exposure
LONG_SIDE = 640  # pixels of the image in which blur is looked for
THUMBNAIL = (40, 30)  # (width, height) of the image in which neighbors are compared
MIN_CORRELATION = 0.8  # of the thumbnails of neighbors that show the same things
BLUR_RATIO = 0.5  # of a frame's fine detail over its neighbor's, below which it is blurred
EXPOSURE_RATIO = 1.35  # between neighbors
DARK, BRIGHT = 0.05, 0.95  # cells outside are noise or clipped
MIN_FRAMES = 8  # with fewer, disorder is not looked for
SHUFFLED_RANK = 0.15  # of the number of frames; median rank of the next camera among the nearest, above which
ASIDE_RATIO = 5.0  # steps to and from a frame over the median step, and over the step from its neighbor to the other

UNITS = {
    "path_length": "capture units",
    "extent": "capture units",
    "median_step": "capture units",
    "median_depth": "capture units",
    "depth_maps_median": "capture units",
    "num_depth_maps": "(a run does not need them; its depths come from the images)",
    "near": "stream units (capture units times scene_scale)",
    "far": "stream units (capture units times scene_scale)",
    "scene_scale": "stream units in a capture unit",
    "focal": "pixels",
    "fov_degrees": "degrees",
    "parallax_degrees": "degrees, median over the matches",
    "step_over_depth": "(median step over median depth)",
}
"""Units of the facts, or what else a reader needs to know, by their names."""


def summarize(
    capture: Capture, config: StreamConfig, advance: Callable[[int], None] = lambda done: None
) -> dict[str, Any]:
    """Facts about a capture for a run with `config`, by name, as plain JSON types; `UNITS` has their units.

    `advance` is called with the number of frames, of at most `NUM_REFERENCES`, that have been matched.
    """
    keypoints = keypoints_of(capture)
    depths = estimate_depths(capture, range(len(capture)), advance, keypoints)
    wrong_poses = pose_warning(fit_poses(capture, capture.convention, keypoints), capture.convention)
    measured = _depth_maps_median(capture)
    scale, near, far = stream_scale(depths, config)
    centers = capture.camtoworlds[:, :3, 3]
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=-1)
    median_step = float(np.median(steps)) if steps.size else 0.0
    K, first = capture.K(0), capture.frames[0]
    if wrong_poses is not None:  # depths that follow from wrong poses would only mislead
        warnings = [wrong_poses]
    else:
        warnings = [*_depth_warnings(capture, depths, steps), *_depth_map_warnings(depths, measured)]
    return {
        "name": capture.name,
        "format": capture.format,
        "num_frames": len(capture),
        "num_depth_maps": sum(map(capture.pixels.has_depth, range(len(capture)))),
        "size": [capture.width, capture.height],  # of delivered images
        "stored_size": [first.width, first.height],
        "focal": [float(K[0, 0]), float(K[1, 1])],
        "fov_degrees": [_field(capture.width, K[0, 0]), _field(capture.height, K[1, 1])],
        "path_length": float(steps.sum()),
        "extent": float(np.linalg.norm(np.ptp(centers, axis=0))),  # diagonal of the camera centers' bounding box
        "median_step": median_step,  # in stream order
        "step_over_depth": median_step / depths.median,
        "median_depth": depths.median,
        "depth_maps_median": measured,
        "depth_source": depths.source,
        "num_matches": depths.num_points,
        "parallax_degrees": depths.parallax_degrees,
        "scene_scale": scale,
        "near": near,
        "far": far,
        "voxel_in_capture_units": config.memory.voxel_size / scale,
        "warnings": [*capture.notes, *warnings, *frame_warnings(capture)],
    }


def _field(extent: int, focal: float) -> float:
    """Field of view in degrees of an image side of `extent` pixels."""
    return float(np.degrees(2 * np.arctan(extent / (2 * focal))))


def _depth_maps_median(capture: Capture) -> float | None:
    """Median of the known depths in some depth maps, in capture units; None without depth maps."""
    owners = list(filter(capture.pixels.has_depth, range(len(capture))))
    chosen = sorted({owners[round(k)] for k in np.linspace(0, len(owners) - 1, NUM_DEPTH_MAPS_READ)}) if owners else []
    known = [depth[depth > 0] for i in chosen if (depth := capture.depth(i)) is not None]
    return float(np.median(np.concatenate(known))) if any(depths.size for depths in known) else None


def _depth_map_warnings(depths: DepthStatistics, measured: float | None) -> list[str]:
    """A warning where depth maps contradict the depths that follow from images and poses."""
    if measured is None or depths.source != "matches":
        return []
    ratio = measured / depths.median
    if 1 / MAX_DEPTH_RATIO <= ratio <= MAX_DEPTH_RATIO:
        return []
    times = f"{ratio:.2g} times that of the matches"
    return [f"The depth maps' median is {times}: check the unit of the depth maps and of the poses."]


def _depth_warnings(capture: Capture, depths: DepthStatistics, steps: np.ndarray) -> list[str]:
    """Likely problems of poses, steps and parallax, each with a remedy."""
    if len(capture) == 1:
        return ["One frame: no parallax, so its depth is a guess; add frames from other places."]
    moved = steps[steps > same_place_distance(capture, range(len(capture)))]
    if not moved.size:
        return ["All cameras stand in one place: no parallax, so depth is a guess; add frames from other places."]
    found = []
    step = float(np.median(steps)) / depths.median
    if depths.source == "baselines" and depths.warning is not None:
        found.append(depths.warning)
    elif depths.source == "poor parallax" or step < LOW_STEP:
        stride = min(max(2, round(GOOD_STEP / max(step, 1e-6))), len(capture))
        found.append(f"Low parallax: a step is {step:.2%} of the median depth; try --stride {stride}.")
    elif depths.parallax_degrees < LOW_PARALLAX_DEGREES:
        found.append(
            f"Little parallax: {depths.parallax_degrees:.1f} degrees at the median, so depth is uncertain; add frames"
            " from the sides, or come closer."
        )
    elif step > HIGH_STEP:
        found.append(f"Wide steps: {step:.0%} of the median depth; neighbors hardly overlap, so add frames between.")
    i, longest = int(steps.argmax()), float(steps.max() / np.median(moved))
    if longest > JUMP_RATIO:
        where = f"{longest:.0f} median steps between frames {i} and {i + 1}"
        found.append(f"A jump of {where}: check that the frames are one stream and in order.")
    focals = [frame.K[0, 0] for frame in capture.frames]
    if max(focals) > MAX_FOCAL_RATIO * min(focals):
        found.append(f"Focal lengths from {min(focals):.0f} to {max(focals):.0f} pixels: check the intrinsics.")
    return found


# -- frames -----------------------------------------------------------------------------------------------------------


def frame_warnings(capture: Capture) -> list[str]:
    """The findings about the frames of `capture`, one sentence with a remedy each."""
    return [*copy_warnings(capture), *order_warnings(capture), *image_warnings(capture)]


def _listed(indices: Sequence[int], num_shown: int = 4) -> str:
    """The first of some frame numbers as text: `3, 8, 9, 20, ...`."""
    return ", ".join(map(str, indices[:num_shown])) + (", ..." if len(indices) > num_shown else "")


def copy_warnings(capture: Capture) -> list[str]:
    """Frames whose image is a copy of an earlier one, byte by byte."""
    lengths = [0 if frame.path is None else frame.path.stat().st_size for frame in capture.frames]
    alike = Counter(lengths)
    originals: dict[bytes, int] = {}
    copies = []
    for i, frame in enumerate(capture.frames):
        if alike[lengths[i]] > 1:
            data = np.ascontiguousarray(capture.image(i)).tobytes() if frame.path is None else frame.path.read_bytes()
            if originals.setdefault(hashlib.sha256(data).digest(), i) != i:
                copies.append(i)
    if not copies:
        return []
    return [f"{len(copies)} images are copies of earlier ones (frames {_listed(copies)}): leave them out."]


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
        f"{len(aside)} cameras stand far off the path between their neighbors (frames {_listed(aside)}): they are out"
        " of order or their poses are wrong; move them or leave them out."
    ]


def _rank(centers: Float64[np.ndarray, "n 3"], i: int) -> int:
    """Place of the camera after camera `i` among those nearest to it, from 1; ties count for it."""
    distances = np.linalg.norm(centers - centers[i], axis=-1)
    return int(np.sum(distances < distances[i + 1])) - (0 if distances[i + 1] == 0 else 1) + 1


def image_warnings(capture: Capture) -> list[str]:
    """Blurred images and jumps of exposure, among neighbors that show the same things."""
    count = len(capture)
    firsts = list(range(count - 1))
    if count > MAX_IMAGES_READ:
        firsts = np.unique(np.linspace(0, count - 2, MAX_IMAGES_READ // 2).round().astype(int)).tolist()
    blurred: set[int] = set()
    jumps: dict[int, float] = {}
    held: dict[int, tuple[np.ndarray, float]] = {}
    for i in firsts:
        held = {k: held[k] if k in held else _thumbnail(capture, k) for k in (i, i + 1)}
        (a, detail), (b, next_detail) = held[i], held[i + 1]
        if min(np.std(a), np.std(b)) < 1e-3 or np.corrcoef(a.ravel(), b.ravel())[0, 1] <= MIN_CORRELATION:
            continue
        if min(detail, next_detail) < BLUR_RATIO * max(detail, next_detail):
            blurred.add(i if detail < next_detail else i + 1)
        usable = (np.minimum(a, b) > DARK) & (np.maximum(a, b) < BRIGHT)
        ratio = float(np.median(b[usable] / a[usable])) if usable.mean() > 0.2 else 1.0
        if max(ratio, 1 / ratio) > EXPOSURE_RATIO:
            jumps[i] = max(ratio, 1 / ratio)
    looked = "" if count <= MAX_IMAGES_READ else f" of the {2 * len(firsts)} looked at"
    warnings = []
    if blurred:
        frames = f"(frames {_listed(sorted(blurred))})"
        warnings.append(f"{len(blurred)} images{looked} are blurred beside their neighbors {frames}: drop them.")
    if jumps:
        warnings.append(
            f"{len(jumps)} jumps of exposure of up to {max(jumps.values()):.1f} times between neighbors{looked} (after"
            f" frames {_listed(sorted(jumps))}): a run evens out up to 4 times; better lock the exposure while filming."
        )
    return warnings


def _thumbnail(capture: Capture, i: int) -> tuple[np.ndarray, float]:
    """Thumbnail of a frame in gray, and the share of its contrast that is fine detail."""
    image = capture.image(i)
    shrink = max(1.0, max(image.shape[:2]) / LONG_SIDE)
    size = (round(image.shape[1] / shrink), round(image.shape[0] / shrink))
    working = gray_image(image, size, Image.Resampling.BOX)
    fine = working - gaussian_filter(working, 1.5)
    detail = float(np.std(fine)) / max(float(np.std(working)), 1e-6)
    return gray_image(image, THUMBNAIL, Image.Resampling.BOX), detail
