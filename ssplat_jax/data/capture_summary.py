"""Summary of a capture for `ssplat inspect`: facts, the scale and depth range of a run, and warnings with remedies."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from ssplat_jax.config import StreamConfig
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.depth_range import DepthStatistics, estimate_depths, same_place_distance, stream_scale
from ssplat_jax.data.frame_check import frame_warnings
from ssplat_jax.data.pose_check import fit_poses, pose_warning
from ssplat_jax.data.sparse_matches import keypoints_of

LOW_STEP = 0.012  # step between frames over median depth, below which four consecutive frames have little parallax
GOOD_STEP = 0.03  # step over median depth that a suggested stride aims at
HIGH_STEP = 0.6  # step over median depth, above which neighboring frames hardly overlap
MAX_FOCAL_RATIO = 4.0  # largest over smallest focal length; above it there is a warning
JUMP_RATIO = 20.0  # step over median step, above which there is a warning

LOW_PARALLAX_DEGREES = 2.0  # median over the points, below which depth is uncertain
MAX_DEPTH_RATIO = 1.5  # median of the depth maps over that of the matches, or its inverse; above it there is a warning
NUM_DEPTH_MAPS_READ = 8  # evenly spread; a median needs no more

_LENGTHS = ("path_length", "extent", "median_step", "median_depth", "depth_maps_median")
_OTHER_UNITS = {
    "num_depth_maps": "(a run does not need them; its depths come from the images)",
    "near": "stream units (capture units times scene_scale)",
    "far": "stream units (capture units times scene_scale)",
    "scene_scale": "stream units in a capture unit",
    "focal": "pixels",
    "fov_degrees": "degrees",
    "parallax_degrees": "degrees, median over the matches",
    "step_over_depth": "(median step over median depth)",
}
UNITS = dict.fromkeys(_LENGTHS, "capture units") | _OTHER_UNITS
"""Units of the facts, or what else a reader needs to know, by their names."""


@dataclasses.dataclass(frozen=True)
class Summary:
    """Facts about a capture; `UNITS` has their units."""

    name: str
    format: str
    num_frames: int
    num_depth_maps: int
    size: tuple[int, int]  # (width, height) of delivered images
    stored_size: tuple[int, int]  # of the first frame
    focal: tuple[float, float]  # pixels of the first delivered image
    fov_degrees: tuple[float, float]
    path_length: float
    extent: float  # diagonal of the camera centers' bounding box
    median_step: float  # between frames in stream order
    step_over_depth: float  # median step over median depth
    median_depth: float
    depth_maps_median: float | None  # of known depths in some depth maps; None without depth maps
    depth_source: str
    num_matches: int
    parallax_degrees: float
    scene_scale: float
    near: float
    far: float
    voxel_in_capture_units: float
    warnings: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Returns the fields as plain JSON types."""
        return {k: list(v) if isinstance(v, tuple) else v for k, v in dataclasses.asdict(self).items()}


def summarize(capture: Capture, config: StreamConfig, advance: Callable[[int], None] = lambda done: None) -> Summary:
    """Returns the summary of a capture for a run with `config`.

    Args:
        capture: the capture.
        config: the configuration that a run would have.
        advance: called with the number of frames, of at most `NUM_REFERENCES`, that have been matched.

    Raises:
        InputError: an image or depth map that the estimates use is damaged.
    """
    keypoints = keypoints_of(capture)
    depths = estimate_depths(capture, range(len(capture)), advance, keypoints)
    wrong_poses = pose_warning(fit_poses(capture, capture.convention, keypoints), capture.convention)
    measured = _depth_maps_median(capture)
    scale, near, far = stream_scale(depths, config)
    centers = capture.camtoworlds[:, :3, 3]
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=-1)
    median_step = float(np.median(steps)) if steps.size else 0.0
    K = capture.K(0)
    return Summary(
        name=capture.name,
        format=capture.format,
        num_frames=len(capture),
        num_depth_maps=sum(capture.pixels.has_depth(i) for i in range(len(capture))),
        size=(capture.width, capture.height),
        stored_size=(capture.frames[0].width, capture.frames[0].height),
        focal=(float(K[0, 0]), float(K[1, 1])),
        fov_degrees=(_fov(capture.width, K[0, 0]), _fov(capture.height, K[1, 1])),
        path_length=float(steps.sum()),
        extent=float(np.linalg.norm(np.ptp(centers, axis=0))),
        median_step=median_step,
        step_over_depth=median_step / depths.median,
        median_depth=depths.median,
        depth_maps_median=measured,
        depth_source=depths.source,
        num_matches=depths.num_points,
        parallax_degrees=depths.parallax_degrees,
        scene_scale=scale,
        near=near,
        far=far,
        voxel_in_capture_units=config.memory.voxel_size / scale,
        warnings=(
            *capture.notes,
            # Depths that follow from wrong poses would only mislead.
            *(_warnings(capture, depths, steps) if wrong_poses is None else [wrong_poses]),
            *(_depth_map_warnings(depths, measured) if wrong_poses is None else []),
            *frame_warnings(capture),
        ),
    )


def _depth_maps_median(capture: Capture) -> float | None:
    """Median of the known depths in some depth maps, in capture units; None without depth maps."""
    owners = [i for i in range(len(capture)) if capture.pixels.has_depth(i)]
    if not owners:
        return None
    chosen = sorted({owners[round(k)] for k in np.linspace(0, len(owners) - 1, NUM_DEPTH_MAPS_READ)})
    maps = [depth for i in chosen if (depth := capture.depth(i)) is not None]
    known = np.concatenate([depth[depth > 0] for depth in maps])
    return float(np.median(known)) if known.size else None


def _depth_map_warnings(depths: DepthStatistics, measured: float | None) -> list[str]:
    """A warning where depth maps contradict the depths that follow from images and poses."""
    if measured is None or depths.source != "matches":
        return []
    ratio = measured / depths.median
    if 1 / MAX_DEPTH_RATIO <= ratio <= MAX_DEPTH_RATIO:
        return []
    return [
        f"The depth maps' median is {ratio:.2g} times that of the matches: check the unit of the depth maps and of the"
        " poses."
    ]


def _fov(extent: int, focal: float) -> float:
    """Field of view in degrees of an image side of `extent` pixels."""
    return float(np.degrees(2 * np.arctan(extent / (2 * focal))))


def _warnings(capture: Capture, depths: DepthStatistics, steps: np.ndarray) -> list[str]:
    """Likely problems of the capture, each with a remedy."""
    if len(capture) == 1:
        return ["One frame: no parallax, so its depth is a guess; add frames from other places."]
    same_place = same_place_distance(capture, range(len(capture)))
    if not (steps > same_place).any():
        return ["All cameras stand in one place: no parallax, so depth is a guess; add frames from other places."]
    found = []
    step = float(np.median(steps)) / depths.median
    if depths.source == "baselines" and depths.warning is not None:
        found.append(depths.warning)
    elif depths.source == "poor parallax" or step < LOW_STEP:
        stride = max(2, round(GOOD_STEP / max(step, 1e-6)))
        found.append(
            f"Low parallax: a step is {step:.2%} of the median depth; try --stride {min(stride, len(capture))}."
        )
    elif depths.parallax_degrees < LOW_PARALLAX_DEGREES:
        found.append(
            f"Little parallax: {depths.parallax_degrees:.1f} degrees at the median, so depth is uncertain; add frames"
            " from the sides, or come closer."
        )
    elif step > HIGH_STEP:
        found.append(f"Wide steps: {step:.0%} of the median depth; neighbors hardly overlap, so add frames between.")
    moved = steps[steps > same_place]
    if (steps > JUMP_RATIO * np.median(moved)).any():
        i = int(steps.argmax())
        found.append(
            f"A jump of {steps[i] / np.median(moved):.0f} median steps between frames {i} and {i + 1}: "
            "check that the frames are one stream and in order."
        )
    focals = [frame.K[0, 0] for frame in capture.frames]
    if max(focals) > MAX_FOCAL_RATIO * min(focals):
        found.append(f"Focal lengths from {min(focals):.0f} to {max(focals):.0f} pixels: check the intrinsics.")
    return found
