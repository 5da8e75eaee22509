"""Summary of a capture for `ssplat inspect`: facts, the scale and depth range of a run, and warnings with remedies."""

from collections.abc import Callable
from typing import Any

import numpy as np

from ssplat_jax.config import StreamConfig
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.depth_range import DepthStatistics, estimate_depths, same_place_distance, stream_scale
from ssplat_jax.data.sparse_matches import fit_poses, keypoints_of, pose_warning

LOW_STEP = 0.012  # step between frames over median depth, below which four consecutive frames have little parallax
GOOD_STEP = 0.03  # step over median depth that a suggested stride aims at
HIGH_STEP = 0.6  # step over median depth, above which neighboring frames hardly overlap
JUMP_RATIO = 20.0  # step over median step, above which there is a warning
LOW_PARALLAX_DEGREES = 2.0  # median over the points, below which depth is uncertain
MIN_FRAMES = 8  # with fewer, disorder is not looked for
SHUFFLED_RANK = 0.15  # of the number of frames; median rank of the next camera among the nearest, above which

UNITS = {
    "path_length": "capture units",
    "extent": "capture units",
    "median_step": "capture units",
    "median_depth": "capture units",
    "depth_maps_median": "capture units",
    "num_depth_maps": "(a run streams them beside the images; it needs none)",
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
    scale, near, far = stream_scale(depths, config)
    centers = capture.camtoworlds[:, :3, 3]
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=-1)
    median_step = float(np.median(steps)) if steps.size else 0.0
    focal, first = np.diag(capture.K(0))[:2], capture.frames[0]
    if wrong_poses is not None:  # depths that follow from wrong poses would only mislead
        warnings = [wrong_poses]
    else:
        warnings = [*_depth_warnings(capture, depths, steps), *capture.depth_map_warnings(depths)]
    return {
        "name": capture.name,
        "format": capture.format,
        "num_frames": len(capture),
        "num_depth_maps": sum(map(capture.pixels.has_depth, range(len(capture)))),
        "size": [capture.width, capture.height],  # of delivered images
        "stored_size": [first.width, first.height],
        "focal": focal.tolist(),
        "fov_degrees": np.degrees(2 * np.arctan([capture.width, capture.height] / (2 * focal))).tolist(),
        "path_length": float(steps.sum()),
        "extent": float(np.linalg.norm(np.ptp(centers, axis=0))),  # diagonal of the camera centers' bounding box
        "median_step": median_step,  # in stream order
        "step_over_depth": median_step / depths.median,
        "median_depth": depths.median,
        "depth_maps_median": capture.depth_maps_median(),
        "depth_source": depths.source,
        "num_matches": depths.num_points,
        "parallax_degrees": depths.parallax_degrees,
        "scene_scale": scale,
        "near": near,
        "far": far,
        "voxel_in_capture_units": config.memory.voxel_size / scale,
        "warnings": [*capture.notes, *warnings, *order_warnings(capture)],
    }


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
        told = f"{depths.parallax_degrees:.1f} degrees at the median, so depth is uncertain"
        found.append(f"Little parallax: {told}; add frames from the sides, or come closer.")
    elif step > HIGH_STEP:
        found.append(f"Wide steps: {step:.0%} of the median depth; neighbors hardly overlap, so add frames between.")
    i, longest = int(steps.argmax()), float(steps.max() / np.median(moved))
    if longest > JUMP_RATIO:
        where = f"{longest:.0f} median steps between frames {i} and {i + 1}"
        found.append(f"A jump of {where}: check that the frames are one stream and in order.")
    return found


def order_warnings(capture: Capture) -> list[str]:
    """Frames whose cameras are not in the order of a path."""
    centers = capture.camtoworlds[:, :3, 3]
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=-1)
    if len(capture) < MIN_FRAMES or not (steps > 0).any():
        return []
    ranks = [np.sum(np.linalg.norm(centers - centers[i], axis=-1) < step) for i, step in enumerate(steps)]
    rank = float(np.median(ranks))
    if rank > max(3.0, SHUFFLED_RANK * len(capture)):
        told = f"the next camera is only the {rank:.0f}th nearest of {len(capture)}, at the median"
        return [f"Frames are not in the order of a path: {told}; name the images in the order of filming."]
    return []
