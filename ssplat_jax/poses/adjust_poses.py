"""`adjust_poses`: poses of a capture that fit its images, near the given ones and in their frame.

frames, given poses -> COLMAP's matches between cameras that look alike -> points from the given poses
                    -> bundle adjustment of poses and points -> the frame of the given poses

It needs `pycolmap` (extra `poses`).
"""

import dataclasses
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, Int
from PIL import Image
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from ssplat_jax.core.console import Reporter
from ssplat_jax.core.errors import refusal
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.depth_range import estimate_depths
from ssplat_jax.data.posed_image import invert_pose
from ssplat_jax.poses import sfm

NUM_PARTNERS = 8  # cameras that each camera is matched with: those most like it
MAX_AXIS_DEGREES = 40.0  # largest angle between the optical axes of a pair
DEGREES_OF_DEPTH = 60.0  # angle between axes that makes cameras as unlike as a distance of one median depth does
MAX_ERROR_DEGREES = 1.6  # of a point from where it was seen: given poses may be wrong by that much
MIN_ANGLE_DEGREES = 0.5  # between two rays to a point
SCALES_DEGREES = (0.4, 0.2)  # scales of the robust loss, one round after another
STIFFNESS = 1e-4  # squared median depths: keeps the unit where cameras are hardly apart
MIN_POINTS = 100  # fewest points from which poses are adjusted
SMALLEST_ERROR_DEGREES = 0.25  # of the given poses, above which `auto` adjusts them: median distance of points
SMALLEST_RATIO = 2.0  # of that error to the one after, above which `auto` adjusts; below, other things are wrong


@dataclasses.dataclass(frozen=True, eq=False)
class AdjustedPoses:
    """The result of `adjust_poses`."""

    capture: Capture  # with adjusted poses
    are_off: bool  # whether the given poses explain the images clearly worse than the adjusted ones
    error_before: float  # median distance of points from where they were seen, degrees
    error_after: float
    turn: float  # median rotation, degrees
    shift: float  # median translation, in median depths of the scene
    num_points: int

    @property
    def reason(self) -> str:
        """A sentence on what was found."""
        if not self.num_points:
            return "poses are not adjusted before the stream: too few points were found in several images"
        return (
            f"poses {'are off' if self.are_off else 'fit'}: points lie {self.error_before:.2f} degrees from where they"
            f" were seen, and {self.error_after:.2f} after turning cameras by {self.turn:.2f} degrees and moving them"
            f" by {100 * self.shift:.1f} % of the depth"
        )


def adjust_poses(
    capture: Capture, indices: Sequence[int] | None = None, advance: Callable[[int], None] = lambda done: None
) -> AdjustedPoses:
    """Adjusts the poses of the frames `indices` (default: all) to the images; other frames keep theirs.

    Poses keep their frame and unit: those of the given poses as a whole. Only the frames `indices` are looked at.

    Args:
        capture: images with poses.
        indices: frames to adjust.
        advance: called with the number of frames that are looked at.

    Returns:
        The capture with adjusted poses, and what was found.

    Raises:
        InputError: `pycolmap` is missing, or an image is damaged.

    Limits:
        With fewer than `MIN_POINTS` points the poses stay. Cameras without a point keep their pose.
    """
    sfm.require("pycolmap")
    used = list(range(len(capture)) if indices is None else indices)
    stays = AdjustedPoses(capture, False, 0.0, 0.0, 0.0, 0.0, 0)
    if len(used) < 2:
        return stays
    depth = estimate_depths(capture, used).median
    # In the first camera's frame: the world's origin may be far away, and its axes must not matter.
    first = capture.frames[used[0]].camtoworld
    given = np.stack([invert_pose(first) @ capture.frames[i].camtoworld for i in used])
    given[:, :3, 3] /= depth
    focal = float(np.median([capture.K(i)[0, 0] for i in used]))
    with tempfile.TemporaryDirectory() as folder:
        model = _triangulated(capture, used, given, focal, Path(folder), advance)
    if model.num_points3D() < MIN_POINTS:
        return stays
    error_before = _adjust(model, focal, SCALES_DEGREES[-1:], is_fixed=True)
    error_after = _adjust(model, focal, SCALES_DEGREES, is_fixed=False)
    found, labels = _poses_and_parts(model, len(used))
    for label in range(labels.max() + 1):
        part = labels == label
        found[part] = _in_frame_of(found[part], given[part])
    frames = list(capture.frames)
    for i, pose in zip(used, found, strict=True):
        place = np.concatenate([pose[:3, :3], depth * pose[:3, 3:]], axis=1)
        frames[i] = dataclasses.replace(frames[i], camtoworld=first @ np.vstack([place, pose[3:]]))
    turns = Rotation.from_matrix(found[:, :3, :3].transpose(0, 2, 1) @ given[:, :3, :3]).magnitude()
    return AdjustedPoses(
        capture=dataclasses.replace(capture, frames=tuple(frames)),
        are_off=error_before > max(SMALLEST_ERROR_DEGREES, SMALLEST_RATIO * error_after),
        error_before=error_before,
        error_after=error_after,
        turn=float(np.degrees(np.median(turns))),
        shift=float(np.median(np.linalg.norm(found[:, :3, 3] - given[:, :3, 3], axis=1))),
        num_points=model.num_points3D(),
    )


def _name(number: int) -> str:
    return f"{number:06d}.png"


def _triangulated(
    capture: Capture,
    used: Sequence[int],
    given: Float64[np.ndarray, "v 4 4"],
    focal: float,
    folder: Path,
    advance: Callable[[int], None],
) -> Any:
    """COLMAP's model of the frames `used` at the given poses, with the points that several of them see."""
    pycolmap = sfm.require("pycolmap")
    sfm.quiet_colmap()
    (folder / "images").mkdir()
    cameras: dict[str, tuple[str, str]] = {}
    for n, i in enumerate(used):
        pixels = np.round(255 * np.clip(capture.image(i), 0.0, 1.0)).astype(np.uint8)
        Image.fromarray(pixels).save(folder / "images" / _name(n), compress_level=1)
        K = capture.K(i)
        cameras[_name(n)] = ("PINHOLE", f"{K[0, 0]}, {K[1, 1]}, {K[0, 2]}, {K[1, 2]}")
    space = sfm.Workspace(folder / "images", folder / "database.db", cameras)
    sfm.extract_features(space, advance)
    sfm.match_pairs(space, alike_cameras(given), lambda done: None)
    model, ids = pycolmap.Reconstruction(), space.ids()
    with pycolmap.Database.open(space.database) as database:
        for camera in database.read_all_cameras():
            model.add_camera_with_trivial_rig(camera)
        for name, pose in zip(cameras, given, strict=True):
            image = database.read_image(ids[name][0])
            model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(invert_pose(pose)[:3]))
    options = pycolmap.IncrementalPipelineOptions(random_seed=sfm.SEED, extract_colors=False)
    options.mapper.random_seed = options.triangulation.random_seed = sfm.SEED
    # As wide as the given poses may be wrong.
    triangulation, pixels = options.triangulation, focal * np.radians(MAX_ERROR_DEGREES)
    triangulation.create_max_angle_error = triangulation.continue_max_angle_error = 2 * MAX_ERROR_DEGREES
    triangulation.merge_max_reproj_error = triangulation.complete_max_reproj_error = pixels
    options.mapper.filter_max_reproj_error = pixels
    triangulation.min_angle = options.mapper.filter_min_tri_angle = MIN_ANGLE_DEGREES
    triangulation.ignore_two_view_tracks = False
    return pycolmap.triangulate_points(model, space.database, space.images, folder, options=options)


def alike_cameras(camtoworlds: Float64[np.ndarray, "v 4 4"]) -> list[sfm.Pair]:
    """Pairs of each camera with the `NUM_PARTNERS` that are most like it in place, in median depths, and direction."""
    centers, axes = camtoworlds[:, :3, 3], camtoworlds[:, :3, 2]
    pairs = set()
    for i in range(len(camtoworlds)):
        angles = np.degrees(np.arccos(np.clip(axes @ axes[i], -1.0, 1.0)))
        unlike = np.linalg.norm(centers - centers[i], axis=1) + angles / DEGREES_OF_DEPTH
        unlike[angles > MAX_AXIS_DEGREES], unlike[i] = np.inf, np.inf
        for j in np.argsort(unlike, kind="stable")[:NUM_PARTNERS].tolist():
            if np.isfinite(unlike[j]):
                pairs.add((min(i, j), max(i, j)))
    return sorted(pairs)


def _adjust(model: Any, focal: float, scales: Sequence[float], *, is_fixed: bool) -> float:
    """Bundle adjustment of poses and points, or of points alone, with a robust loss that grows stricter.

    Returns:
        The median distance of points from where they are seen, in degrees.
    """
    pycolmap = sfm.require("pycolmap")
    for scale in scales:
        options = pycolmap.BundleAdjustmentOptions(refine_focal_length=False, refine_extra_params=False)
        options.refine_rig_from_world, options.print_summary = not is_fixed, False
        options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
        options.ceres.loss_function_scale = focal * np.radians(scale)
        sfm.bundle_adjust(model, options)
    model.update_point_3d_errors()
    return float(np.degrees(np.median([point.error for point in model.points3D.values()]) / focal))


def _poses_and_parts(model: Any, num: int) -> tuple[Float64[np.ndarray, "v 4 4"], Int[np.ndarray, " v"]]:
    """Camera-to-world of the cameras, and which of them points connect: parts have no frame in common."""
    images = {image.name: image for image in model.images.values()}
    numbers = {images[_name(n)].image_id: n for n in range(num)}
    tracks = [[numbers[seen.image_id] for seen in point.track.elements] for point in model.points3D.values()]
    ends = np.array([(track[0], other) for track in tracks for other in track])
    links = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), (num, num))
    viewmats = [np.vstack([images[_name(n)].cam_from_world().matrix(), [0.0, 0.0, 0.0, 1.0]]) for n in range(num)]
    return np.stack([invert_pose(viewmat) for viewmat in viewmats]), connected_components(links, directed=False)[1]


def _in_frame_of(
    found: Float64[np.ndarray, "v 4 4"], given: Float64[np.ndarray, "v 4 4"]
) -> Float64[np.ndarray, "v 4 4"]:
    """Poses after the similarity that brings them as a whole to the given ones; a single one becomes the given one.

    Bundle adjustment leaves frame and unit open. The mean of all rotations tells more of the frame than places do,
    which may lie on a line.
    """
    turn = Rotation.from_matrix(given[:, :3, :3] @ found[:, :3, :3].transpose(0, 2, 1)).mean().as_matrix()
    center, around = given[:, :3, 3].mean(axis=0), (found[:, :3, 3] - found[:, :3, 3].mean(axis=0)) @ turn.T
    scale = (np.sum(around * (given[:, :3, 3] - center)) + STIFFNESS) / (np.sum(around**2) + STIFFNESS)
    out = np.array(found)
    out[:, :3, :3], out[:, :3, 3] = turn @ found[:, :3, :3], center + scale * around
    return out


def check_look_ahead(revise: str | None, *, is_causal: bool) -> None:
    """Refuses to adjust the poses of a causal stream, which looks at all frames."""
    if is_causal and revise:
        got, fix = "a causal one (--causal, or stream.causal=true)", "leave one out"
        raise refusal(f"--revise {revise}", wanted="a stream that may look ahead", got=got, fix=fix)


def adjust_if_asked(
    capture: Capture, indices: Sequence[int], revise: str | None, reporter: Reporter
) -> AdjustedPoses | None:
    """The adjusted poses of a stream that has not begun, if `revise` asks for them; says what was found.

    Returns:
        The adjusted poses; None if `revise` is None, if it is `auto` and the given ones fit, or if too few points were
        found to adjust them by.
    """
    if revise is None:
        return None
    with reporter.progress("poses", len(indices), waiting="") as advance:
        found = adjust_poses(capture, indices, advance)
    reporter.say(found.reason)
    return found if found.num_points > 0 and (found.are_off or revise == "poses") else None
