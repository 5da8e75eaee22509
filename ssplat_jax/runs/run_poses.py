"""Poses of a run that were adjusted before the stream: found once, kept in the folder, used by all that follows."""

import dataclasses
import json
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from ssplat_jax.console import Reporter
from ssplat_jax.data.capture import Capture
from ssplat_jax.errors import StorageError, refusal
from ssplat_jax.poses.adjust_poses import adjust_if_asked
from ssplat_jax.storage.json_files import write_json
from ssplat_jax.storage.run_folder import RunFolder


def capture_to_stream(
    capture: Capture, indices: Sequence[int], revise: Sequence[str], folder: RunFolder, reporter: Reporter
) -> Capture:
    """The capture with the poses that a run streams: adjusted ones, if `revise` asks for them.

    Args:
        capture: the capture as it was opened.
        indices: frames to stream.
        revise: names of effects; see `poses.adjust_poses.adjust_if_asked`.
        folder: where a run keeps its adjusted poses; a run that is continued finds them there.
        reporter: shows progress.

    Raises:
        InputError: the folder holds a run whose poses were not adjusted.
        StorageError: the folder cannot be written, or the saved poses are damaged.
    """
    asked = [name for name in ("poses", "auto") if name in revise]
    if not folder.has_state() and not _has_poses_for(folder, capture, indices, asked):
        folder.adjusted_poses.unlink(missing_ok=True)  # of a run that stopped before its first save
    if not asked:
        return capture
    saved = _read(folder)
    if folder.has_state() and (saved is None or ("poses" in asked and not saved.camtoworlds)):
        got, fix = "one with the given poses", "leave it out, or start anew with --overwrite"
        raise refusal(f"--revise {asked[0]}", wanted="a run that began with it", got=got, fix=fix)
    if saved is None:
        found = adjust_if_asked(capture, indices, revise, reporter)
        frames = {} if found is None else {str(i): found.capture.frames[i].camtoworld.tolist() for i in indices}
        described = {"capture": capture.digest(indices), "indices": list(indices), "camtoworlds": frames}
        write_json(folder.adjusted_poses, described)
    return with_poses_of_run(capture, folder)


def _has_poses_for(folder: RunFolder, capture: Capture, indices: Sequence[int], asked: Sequence[str]) -> bool:
    """True if the folder keeps poses of the same frames of the same capture that do what is asked."""
    saved = _read(folder)
    if saved is None or not asked:
        return False
    return saved.capture == capture.digest(indices) and (bool(saved.camtoworlds) or "poses" not in asked)


def with_poses_of_run(capture: Capture, folder: RunFolder) -> Capture:
    """`capture` with the adjusted poses that `folder` keeps; as it is, if there are none or if they are of another.

    Raises:
        StorageError: the saved poses are damaged.
    """
    saved = _read(folder)
    if saved is None or max(saved.indices, default=0) >= len(capture) or capture.digest(saved.indices) != saved.capture:
        return capture  # if they are of another, its digest differs from that of the run, which says so
    frames = [
        dataclasses.replace(frame, camtoworld=saved.camtoworlds[i]) if i in saved.camtoworlds else frame
        for i, frame in enumerate(capture.frames)
    ]
    return dataclasses.replace(capture, frames=tuple(frames))


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
    camtoworlds: dict[int, Float64[np.ndarray, "4 4"]]  # by frame; empty if the given ones were streamed


def _read(folder: RunFolder) -> _SavedPoses | None:
    """The poses that `folder` keeps, or None."""
    if not folder.adjusted_poses.exists():
        return None
    try:
        fields = json.loads(folder.adjusted_poses.read_text())
        poses = {int(i): np.array(pose, np.float64).reshape(4, 4) for i, pose in fields["camtoworlds"].items()}
        if not all(np.isfinite(pose).all() for pose in poses.values()):
            raise ValueError("a pose is not finite")
        return _SavedPoses(str(fields["capture"]), [int(i) for i in fields["indices"]], poses)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise StorageError(f"{folder.adjusted_poses}: damaged; --overwrite starts the run anew.") from error
