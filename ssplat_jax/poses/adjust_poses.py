"""`adjust_poses`: poses of a capture that fit its images, near the given ones and in their frame."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from ssplat_jax.core.console import Reporter
from ssplat_jax.core.errors import refusal
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.depth_range import estimate_depths
from ssplat_jax.data.posed_image import invert_pose
from ssplat_jax.poses.bundle_adjustment import adjust, find_tracks, moved

ROTATION_DEVIATION = 0.005
"""Assumed error of the given rotations in radians. Real errors are larger, half a degree on phones after some time. The
smaller value gives the given poses more weight: errors of neighboring matches are alike, and thousands of them tell
less than as many independent ones."""
TRANSLATION_DEVIATION = 0.005  # assumed error of the given places, in median depths of the scene
SCALES_DEGREES = (0.4, 0.2)  # scales of the robust loss, one round after another
MIN_TRACKS = 100  # fewest points from which poses are adjusted


@dataclasses.dataclass(frozen=True, eq=False)
class AdjustedPoses:
    """The result of `adjust_poses`."""

    capture: Capture  # with adjusted poses
    error_before: float  # median distance of points from where they were seen, degrees
    error_after: float
    turn: float  # median rotation, degrees
    shift: float  # median translation, in median depths of the scene
    num_points: int

    @property
    def reason(self) -> str:
        """A sentence on what was found."""
        if not self.num_points:
            return "poses are not adjusted: too few points were found in several images"
        return (
            f"poses are adjusted: points lie {self.error_before:.2f} degrees from where they were seen, and"
            f" {self.error_after:.2f} after turning cameras by {self.turn:.2f} degrees and moving them by"
            f" {100 * self.shift:.1f} % of the depth"
        )


def adjust_poses(
    capture: Capture, indices: Sequence[int] | None = None, advance: Callable[[int], None] = lambda done: None
) -> AdjustedPoses:
    """Adjusts the poses of the frames `indices` (default: all) to the images; other frames keep theirs.

    Poses stay near the given ones, within what `ROTATION_DEVIATION` and `TRANSLATION_DEVIATION` make likely, and keep
    their frame and unit. Only the frames `indices` are looked at.

    Args:
        capture: images with poses.
        indices: frames to adjust.
        advance: called with the number of frames that are looked at.

    Returns:
        The capture with adjusted poses, and what was found.

    Raises:
        InputError: an image is damaged.

    Limits:
        With fewer than `MIN_TRACKS` points the poses stay. Cameras without a point keep their pose.
    """
    used = list(range(len(capture)) if indices is None else indices)
    depth = estimate_depths(capture, used).median
    seen = find_tracks(capture, used, depth, advance)
    if seen.num_points < MIN_TRACKS:
        return AdjustedPoses(capture, 0.0, 0.0, 0.0, 0.0, 0)
    focal = float(np.median(seen.Ks[:, 0, 0]))
    scales = [focal * np.radians(scale) for scale in SCALES_DEGREES]
    found = adjust(seen, scales, (ROTATION_DEVIATION, TRANSLATION_DEVIATION))
    before, after = (float(np.degrees(np.median(errors) / focal)) for errors in (found.errors_before, found.errors))
    frames, first = list(capture.frames), capture.frames[used[0]].camtoworld
    for i, viewmat in zip(used, moved(seen.viewmats, found.twists), strict=True):
        camtoworld = invert_pose(viewmat)
        camtoworld[:3, 3] *= depth
        frames[i] = dataclasses.replace(frames[i], camtoworld=first @ camtoworld)
    return AdjustedPoses(
        capture=dataclasses.replace(capture, frames=tuple(frames)),
        error_before=before,
        error_after=after,
        turn=float(np.degrees(np.median(np.linalg.norm(found.twists[:, :3], axis=1)))),
        shift=float(np.median(np.linalg.norm(found.twists[:, 3:], axis=1))),
        num_points=seen.num_points,
    )


def check_look_ahead(*, is_asked: bool, is_causal: bool) -> None:
    """Checks that no causal stream is asked to adjust its poses, which looks at all frames.

    Raises:
        InputError: it is.
    """
    if is_causal and is_asked:
        got, fix = "a causal one (--causal, or stream.causal=true)", "leave one out"
        raise refusal("--adjust-poses", wanted="a stream that may look ahead", got=got, fix=fix)


def adjust_and_say(capture: Capture, indices: Sequence[int], reporter: Reporter) -> AdjustedPoses:
    """`adjust_poses` with a progress bar; says what was found."""
    with reporter.progress("poses", len(indices), waiting="") as advance:
        found = adjust_poses(capture, indices, advance)
    reporter.say(found.reason)
    return found
