"""Poses of a run that were adjusted before the stream: found once, kept in the folder, used by all that follows."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from ssplat_jax.core.console import Reporter
from ssplat_jax.core.errors import refusal
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.poses.adjust_poses import adjust_if_asked
from ssplat_jax.storage.files import load_arrays, save_arrays
from ssplat_jax.storage.run_folder import RunFolder

KIND = "adjusted poses 1"


@dataclasses.dataclass(frozen=True)
class SavedPoses:
    """The adjusted poses that a run keeps, and what they were adjusted from."""

    capture: str  # digest of the poses as given
    indices: list[int]  # streamed frames
    asked: str  # `poses` or `auto`
    camtoworlds: dict[int, Float64[np.ndarray, "4 4"]]  # by frame; empty if the given ones were streamed

    def of(self, capture: Capture) -> Capture | None:
        """The capture with these poses; None if they belong to another capture."""
        if max(self.indices, default=0) >= len(capture) or capture.digest(self.indices) != self.capture:
            return None
        frames = [
            dataclasses.replace(frame, camtoworld=self.camtoworlds[i]) if i in self.camtoworlds else frame
            for i, frame in enumerate(capture.frames)
        ]
        return dataclasses.replace(capture, frames=tuple(frames))

    def save(self, folder: RunFolder) -> None:
        """Writes the poses to the folder of the run."""
        arrays = {str(i): pose for i, pose in self.camtoworlds.items()}
        header = {"capture": self.capture, "indices": self.indices, "asked": self.asked}
        save_arrays(folder.adjusted_poses, arrays, KIND, header)


def load_poses(folder: RunFolder) -> SavedPoses | None:
    """The poses that `folder` keeps, or None.

    Raises:
        StorageError: they are damaged.
    """
    if not folder.adjusted_poses.exists():
        return None
    arrays, header = load_arrays(folder.adjusted_poses, KIND)
    return SavedPoses(**header, camtoworlds={int(i): pose for i, pose in arrays.items()})


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
        StorageError: the saved poses are damaged.
    """
    if revise is None:
        if not folder.has_state():  # left by a run that was stopped before its first save
            folder.adjusted_poses.unlink(missing_ok=True)
        return capture
    saved = load_poses(folder)
    if folder.has_state():
        if saved is None or (revise == "poses" and not (saved.camtoworlds or saved.asked == "poses")):
            got, fix = "one with the given poses", "leave it out, or start anew with --overwrite"
            raise refusal(f"--revise {revise}", wanted="a run that began with it", got=got, fix=fix)
    elif saved is None or (saved.asked, saved.capture) != (revise, capture.digest(indices)):
        found = adjust_if_asked(capture, indices, revise, reporter)
        frames = {} if found is None else {i: found.capture.frames[i].camtoworld for i in indices}
        saved = SavedPoses(capture.digest(indices), list(indices), revise, frames)
        saved.save(folder)
    return saved.of(capture) or capture


def with_poses_of_run(capture: Capture, folder: RunFolder) -> Capture:
    """`capture` with the adjusted poses that `folder` keeps; as it is, if there are none or those of another capture.

    Resuming then fails, because the capture's digest differs from that of the run.

    Raises:
        StorageError: the saved poses are damaged.
    """
    saved = load_poses(folder)
    return capture if saved is None else saved.of(capture) or capture


def open_capture_of_scene(scene: Path, path: str, size: tuple[int, int] | None, reporter: Reporter) -> Capture:
    """The capture at `path`, with the adjusted poses of the run that `scene`, a file or a folder, belongs to.

    A warning says so if the run kept adjusted poses of another capture, or of this one at another size.

    Raises:
        InputError: the capture is unusable.
        StorageError: the saved poses are damaged.
    """
    folder, capture = RunFolder(scene if scene.is_dir() else scene.parent), open_capture(path, size=size)
    saved = load_poses(folder)
    if saved is None or not saved.camtoworlds:
        return capture
    if (adjusted := saved.of(capture)) is None:
        reporter.warn(f"{folder.adjusted_poses} is of another capture: the cameras have the poses of {path}.")
    return adjusted or capture
