"""`ssplat export`: the scene of a run as a person gets it, and the cameras of its capture as COLMAP text beside it."""

from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
from scipy.spatial.transform import Rotation

from ssplat_jax.core.atomic import write_atomic
from ssplat_jax.core.console import Reporter
from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import Gaussians, scale_colors
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.posed_image import invert_pose
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.runs.open_run import load_run
from ssplat_jax.runs.run_poses import open_capture_of_scene
from ssplat_jax.scene_files.formats import ExportReport, check_format, save_gaussians
from ssplat_jax.storage.run_folder import RunFolder
from ssplat_jax.streaming.feed import Exposures, middle_exposure

TITLE = "# Cameras of a scene, written by ssplat export"
FILES = ("cameras.txt", "images.txt", "points3D.txt")


def scene_to_show(gaussians: Gaussians, frame: StreamFrame, exposures: Exposures) -> Gaussians:
    """Gaussians of the stream as a person gets them: in the capture's frame, at the middle exposure of the stream.

    The cache keeps the exposure of the first views, which may lie in the shade: at the median of all, no scene is too
    dark to look at.

    Args:
        gaussians: the scene, in the stream frame, at the exposure of the first views.
        frame: the similarity between both frames; positions of the result are relative to its offset.
        exposures: exposures of the streamed frames.
    """
    factors = jnp.asarray(middle_exposure(exposures), jnp.float32)
    return frame.gaussians_to_capture(scale_colors(gaussians, factors), offset=frame.offset)


def save_scene(path: Path, gaussians: Gaussians, frame: StreamFrame, exposures: Exposures) -> ExportReport:
    """Writes Gaussians of the stream as a person gets them (`scene_to_show`); the path's suffix names the format.

    Raises:
        StorageError: the file cannot be written.
    """
    return save_gaussians(path, scene_to_show(gaussians, frame, exposures), offset=frame.offset)


def export_run(
    run_dir: Path, to: Path, params: dict, reporter: Reporter, max_splats: int | None = None
) -> ExportReport:
    """Decodes the saved state of a run and writes its scene, in the capture's frame, at the middle exposure.

    Args:
        run_dir: folder of the run.
        to: file to write; its suffix names the format.
        params: parameters of the run's model.
        reporter: warns if only the state before the newest can be read.
        max_splats: most Gaussians to write.

    Raises:
        InputError: no run there, a run with other weights, or a suffix of no known format.
        StorageError: the state is corrupt, or `to` cannot be written.
    """
    check_format(to)
    run = load_run(run_dir, reporter)
    session = run.session(params)
    num_shown = int(session.cache_facts()["decoded"])
    # The rows after these are padding, of which a person need not be told.
    gaussians = jax.tree.map(lambda x: x[:num_shown], session.gaussians())
    scene = scene_to_show(gaussians, run.frame, run.exposures)
    return save_gaussians(to, scene, offset=run.frame.offset, max_splats=max_splats)


Cameras = tuple[Capture, Sequence[int]]
"""A capture, and those of its frames whose cameras belong to a scene."""


def open_cameras(path: str, scene: Path, to: Path, reporter: Reporter) -> Cameras:
    """The cameras of the capture at `path`: those that a run streamed, or all if `scene` is a file.

    They are to be written beside the scene file `to`.

    Raises:
        InputError: the capture is unusable or not that of the run, or files of other makers are in the way.
        StorageError: the run's state or its adjusted poses are corrupt.
    """
    for name in FILES:
        held = to.parent / name
        if held.exists() and not held.read_bytes().startswith(TITLE.encode("ascii")):
            raise InputError(f"{held}: wanted a place for the cameras, a file is in the way; choose another folder.")
    if not RunFolder(scene).has_state():
        capture = open_capture_of_scene(scene, path, None, reporter)
        return capture, range(len(capture))
    run = load_run(scene, reporter)
    return run.open_capture(path), sorted(run.exposures)


def save_cameras(folder: Path, cameras: Cameras, offset: tuple[float, float, float]) -> None:
    """Writes the three files of a COLMAP model, after colmap.github.io/format.html.

    `cameras.txt` holds pinhole cameras, `images.txt` poses from world to camera as a quaternion wxyz and a translation,
    both for images as they are delivered: without lens distortion, at the size that was streamed. `points3D.txt` is
    empty; COLMAP does not open a model without it. SuperSplat shows the cameras of `images.txt`.

    Positions are relative to `offset`, a point of the capture's frame, as in the scene beside.

    Raises:
        StorageError: a file cannot be written.
    """
    capture, indices = cameras
    ids: dict[tuple, int] = {}  # of different intrinsics, in order
    lines = []
    for number, i in enumerate(indices, start=1):
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
        # Names on Linux are bytes; Python keeps those that are no UTF-8 as surrogates.
        write_atomic(folder / name, "\n".join([TITLE, *content, ""]).encode(errors="surrogateescape"))
