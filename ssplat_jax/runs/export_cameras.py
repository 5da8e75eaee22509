"""`ssplat export --cameras`: the cameras of a capture as COLMAP text beside an exported scene.

`cameras.txt` holds pinhole cameras, `images.txt` poses from world to camera as a quaternion wxyz and a translation,
both for images as they are delivered: without lens distortion, at the size that was streamed. `points3D.txt` is empty;
COLMAP does not open a model without it. SuperSplat shows the cameras of `images.txt`.
Reference: colmap.github.io/format.html.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from scipy.spatial.transform import Rotation

from ssplat_jax.core.atomic import write_atomic
from ssplat_jax.core.console import Reporter
from ssplat_jax.core.errors import InputError
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.data.posed_image import invert_pose
from ssplat_jax.runs.run_poses import open_capture_of_scene, with_poses_of_run
from ssplat_jax.storage.run_folder import RunFolder
from ssplat_jax.storage.saved_states import load_newest_state

TITLE = "# Cameras of a scene, written by ssplat export"
FILES = ("cameras.txt", "images.txt", "points3D.txt")


@dataclasses.dataclass(frozen=True)
class SceneCameras:
    """Cameras that belong to a scene."""

    capture: Capture
    indices: Sequence[int]  # frames


def open_cameras(path: str, scene: Path, to: Path, reporter: Reporter) -> SceneCameras:
    """The cameras of a capture: those that a run streamed, or all if the scene is a file.

    Args:
        path: the capture, as `open_capture` takes it.
        scene: folder of a run, or a scene file.
        to: the scene file to write, beside which the cameras will be.
        reporter: shows warnings.

    Raises:
        InputError: the capture is unusable or not that of the run, or files of other makers are in the way.
        StorageError: the run's state or its adjusted poses are corrupt.
    """
    for name in FILES:
        held = to.parent / name
        if held.exists() and not held.read_bytes().startswith(TITLE.encode("ascii")):
            raise InputError(f"{held}: wanted a place for the cameras, a file is in the way; choose another folder.")
    folder = RunFolder(scene)
    if not folder.has_state():
        capture = open_capture_of_scene(scene, path, None, reporter)
        return SceneCameras(capture, range(len(capture)))
    _, header, _ = load_newest_state(folder.state)
    capture = with_poses_of_run(open_capture(path, size=tuple(header["size"])), folder)
    frames = header["frames"]
    if max(frames) >= len(capture) or capture.digest(frames) != header["poses"]:
        raise InputError(f"{path}: wanted the capture of the run in {scene}, got another; give that capture.")
    return SceneCameras(capture, sorted(map(int, header["exposures"])))


def save_cameras(folder: Path, cameras: SceneCameras, offset: tuple[float, float, float]) -> None:
    """Writes the three files of a COLMAP model.

    Args:
        folder: where to.
        cameras: the cameras.
        offset: point of the capture's frame to which positions are relative, as in the scene beside.

    Raises:
        StorageError: a file cannot be written.
    """
    capture = cameras.capture
    ids: dict[tuple, int] = {}  # of different intrinsics, in order
    lines = []
    for number, i in enumerate(cameras.indices, start=1):
        K, camtoworld = capture.K(i), capture.frames[i].camtoworld.copy()
        camtoworld[:3, 3] -= offset
        viewmat = invert_pose(camtoworld)
        quat = Rotation.from_matrix(viewmat[:3, :3]).as_quat(scalar_first=True, canonical=True)
        camera = ids.setdefault((K[0, 0], K[1, 1], K[0, 2], K[1, 2]), len(ids) + 1)
        pose = " ".join(repr(float(x)) for x in (*quat, *viewmat[:3, 3]))
        lines += [f"{number} {pose} {camera} {capture.frames[i].name}", ""]  # the second line: no points
    size = f"{capture.width} {capture.height}"
    pinholes = [f"{number} PINHOLE {size} {' '.join(repr(float(x)) for x in K)}" for K, number in ids.items()]
    contents = (
        ["# id, model, width, height, fx, fy, cx, cy", *pinholes],
        ["# id, qw, qx, qy, qz, tx, ty, tz, camera, name; then a line of points", *lines],
        ["# no points"],
    )
    for name, content in zip(FILES, contents, strict=True):
        write_atomic(folder / name, "\n".join([TITLE, *content, ""]).encode(errors="surrogateescape"))
