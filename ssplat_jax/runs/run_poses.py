"""Poses of a run that were adjusted before the stream: found once, kept in the folder, used by all that follows."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from ssplat_jax.core.console import Reporter
from ssplat_jax.core.errors import StorageError, refusal
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.poses.adjust_poses import adjust_if_asked
from ssplat_jax.storage.files import write_json
from ssplat_jax.storage.run_folder import RunFolder


def capture_to_stream(
    capture: Capture, indices: Sequence[int], revise: str | None, folder: RunFolder, reporter: Reporter
) -> Capture:
    """The capture with the poses that a run streams: adjusted ones, if `revise` asks for them.

    Args:
        capture: the capture as it was opened.
        indices: frames to stream.
        revise: `poses`, `auto` or None; see `poses.adjust_poses.adjust_if_asked`.
        folder: where a run keeps its adjusted poses; a run that is continued finds them there.
        reporter: shows progress.

    Raises:
        InputError: the folder holds a run whose poses were not adjusted.
        StorageError: the folder cannot be written, or the saved poses are damaged.
    """
    if revise is None:
        forget_poses_without_run(folder)
        return capture
    saved = _read(folder)
    if folder.has_state():
        if saved is None or (revise == "poses" and not (saved.camtoworlds or saved.asked == "poses")):
            got, fix = "one with the given poses", "leave it out, or start anew with --overwrite"
            raise refusal(f"--revise {revise}", wanted="a run that began with it", got=got, fix=fix)
    elif saved is None or (saved.asked, saved.capture) != (revise, capture.digest(indices)):
        # None, or those of a run that was stopped before its first save and had another request.
        found = adjust_if_asked(capture, indices, revise, reporter)
        frames = {} if found is None else {i: found.capture.frames[i].camtoworld for i in indices}
        saved = _SavedPoses(capture.digest(indices), list(indices), revise, frames)
        _write(folder, saved)
    return _with_poses(capture, saved) or capture


def forget_poses_without_run(folder: RunFolder) -> None:
    """Removes adjusted poses that a run left behind which was stopped before its first save."""
    if not folder.has_state():
        folder.adjusted_poses.unlink(missing_ok=True)


def with_poses_of_run(capture: Capture, folder: RunFolder) -> Capture:
    """`capture` with the adjusted poses that `folder` keeps; as it is, if there are none or those of another capture.

    The digest of another capture differs from that of the run, which whoever continues the run compares.

    Raises:
        StorageError: the saved poses are damaged.
    """
    saved = _read(folder)
    return capture if saved is None else _with_poses(capture, saved) or capture


def open_capture_of_scene(scene: Path, path: str, size: tuple[int, int] | None, reporter: Reporter) -> Capture:
    """The capture at `path`, with the adjusted poses of the run that a scene belongs to.

    Args:
        scene: a scene file, or the folder of a run.
        path: the capture, as `open_capture` takes it.
        size: (width, height) of its images; by default its own.
        reporter: warns if the run kept adjusted poses of another capture, or of this one at another size.

    Raises:
        InputError: the capture is unusable.
        StorageError: the saved poses are damaged.
    """
    folder, capture = RunFolder(scene if scene.is_dir() else scene.parent), open_capture(path, size=size)
    saved = _read(folder)
    if saved is None or not saved.camtoworlds:
        return capture
    if (adjusted := _with_poses(capture, saved)) is None:
        reporter.warn(f"{folder.adjusted_poses} is of another capture: the cameras have the poses of {path}.")
    return adjusted or capture


def has_adjusted_poses(folder: RunFolder) -> bool:
    """True if the run in `folder` streamed adjusted poses.

    Raises:
        StorageError: the saved poses are damaged.
    """
    saved = _read(folder)
    return saved is not None and bool(saved.camtoworlds)


@dataclasses.dataclass(frozen=True)
class _SavedPoses:
    capture: str  # digest of the poses as given
    indices: list[int]  # streamed frames
    asked: str  # `poses` or `auto`
    camtoworlds: dict[int, Float64[np.ndarray, "4 4"]]  # by frame; empty if the given ones were streamed


def _with_poses(capture: Capture, saved: _SavedPoses) -> Capture | None:
    """The capture with saved poses; None if they are those of another capture."""
    if max(saved.indices, default=0) >= len(capture) or capture.digest(saved.indices) != saved.capture:
        return None
    frames = [
        dataclasses.replace(frame, camtoworld=saved.camtoworlds[i]) if i in saved.camtoworlds else frame
        for i, frame in enumerate(capture.frames)
    ]
    return dataclasses.replace(capture, frames=tuple(frames))


def _write(folder: RunFolder, saved: _SavedPoses) -> None:
    camtoworlds = {str(i): pose.tolist() for i, pose in saved.camtoworlds.items()}
    write_json(folder.adjusted_poses, dataclasses.asdict(saved) | {"camtoworlds": camtoworlds})


def _read(folder: RunFolder) -> _SavedPoses | None:
    """The poses that `folder` keeps, or None."""
    if not folder.adjusted_poses.exists():
        return None
    try:
        fields = json.loads(folder.adjusted_poses.read_text())
        poses = {int(i): np.array(pose, np.float64).reshape(4, 4) for i, pose in fields["camtoworlds"].items()}
        if not all(np.isfinite(pose).all() for pose in poses.values()):
            raise ValueError("a pose is not finite")
        return _SavedPoses(str(fields["capture"]), [int(i) for i in fields["indices"]], str(fields["asked"]), poses)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise StorageError(f"{folder.adjusted_poses}: damaged; --overwrite starts the run anew.") from error
