"""What every reader does with what it found: look for files, check a frame, put frames into the order of streaming."""

import dataclasses
import itertools
import math
import posixpath
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from ssplat_jax.data.images import image_size
from ssplat_jax.data.lens import IGNORED_PX, PINHOLE, Lens, check_lens
from ssplat_jax.data.posed_image import MILLIMETER, ROTATION_ROUNDING, Frame, check_intrinsics
from ssplat_jax.data.readers import Listing
from ssplat_jax.errors import echo, refusal

MUCH_SHORTER = 0.5  # of the camera's way by name: the file's order is taken
FAR_OFF_CENTER = 0.2  # of a side: a principal point so far off is worth a note
EXTENSIONS = ("", ".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG", ".webp")
SHRUNK_FOLDERS = ("images_2", "images_4", "images_8")  # where images/ was left out of a download


@dataclasses.dataclass(frozen=True)
class Intrinsics:
    """Of the image as described, which the stored one may be a smaller copy of, in its pixels."""

    fx: float
    fy: float
    cx: float
    cy: float
    lens: Lens = PINHOLE


def find_file(root: Path, names: Sequence[str], where: str) -> Path | None:
    """The first of `names` that is a file of the capture; symbolic links are followed before it is judged.

    Raises:
        InputError: one lies outside `root`.
    """
    for name in names:
        try:
            path = (root / name).resolve()
            found = path.is_file()
        except (OSError, RuntimeError, ValueError):  # too long a name, a loop of links
            continue
        if not path.is_relative_to(root):
            fix = "copy the file into the capture's folder and give its relative path"
            raise refusal(where, wanted=f"a path inside {root}", got=echo(name), fix=fix)
        if found:
            return path
    return None


def file_named(
    root: Path, name: object, where: str, extensions: tuple[str, ...] = ("",), folders: tuple[str, ...] = ()
) -> Path:
    """The file `name` of the capture, its extension completed. A name in images/ may lie in one of `folders` instead.

    Raises:
        InputError: no such file, or outside `root`.
    """
    if not isinstance(name, str) or not name or "\0" in name:
        raise refusal(where, wanted="the path of a file", got=echo(name), fix="give it relative to the capture")
    below = in_images(name)
    names = [name, *(f"{folder}/{below}" for folder in folders if below is not None)]
    path = find_file(root, [n + extension for n in names for extension in extensions], where)
    if path is None:
        got = f"{echo(name)}, which does not exist"
        raise refusal(where, wanted="an existing file", got=got, fix="add the file or drop the frame")
    return path


def in_images(name: str) -> str | None:
    """What follows images/ in a file's name, which may begin with ./; None of others."""
    plain = posixpath.normpath(name)
    return plain.removeprefix("images/") if plain.startswith("images/") else None


def stored_size(path: Path, described: tuple[float, float], where: str, fix: str) -> tuple[tuple[int, int], float]:
    """(width, height) of the stored image, and how much smaller it is than it is `described`.

    Folders of shrunk images (images_2, images_4) keep the intrinsics of the full size: both sides shrunk alike, to a
    pixel, are taken for such. Larger images than described are not.
    """
    width, height = image_size(path)
    if described == (width, height):
        return (width, height), 1.0
    shrink = max(width, height) / max(*described, 1e-9)  # the longer side is rounded less
    if shrink < 1 and all(abs(w * shrink - side) <= 1.0 for w, side in zip(described, (width, height), strict=True)):
        return (width, height), shrink
    if described == (height, width):
        fix = "the image lies on its side: rotate the file (EXIF orientation is not applied) or swap the intrinsics"
    came = f"{width}x{height} in {path.name}"
    raise refusal(where, wanted=f"{described[0]:g}x{described[1]:g}", got=came, fix=fix)


def make_frame(
    name: str,
    path: Path,
    camtoworld: Float64[np.ndarray, "4 4"],
    intrinsics: Intrinsics,
    size: tuple[int, int],
    where: str,
    *,
    pose_deviation: float = 0.0,
    shrink: float = 1.0,
    depth_path: Path | None = None,
    depth_unit: float = MILLIMETER,
) -> Frame:
    """A frame of a checked pose, OpenCV axes; its intrinsics are checked here. `size` is the stored image's."""
    fx, fy, cx, cy = (shrink * x for x in (intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy))
    K = check_intrinsics(fx=fx, fy=fy, cx=cx, cy=cy, width=size[0], height=size[1], where=where)
    distortion_px = check_lens(intrinsics.lens, K, *size, where)
    return Frame(
        name=name,
        camtoworld=camtoworld,
        K=K,
        width=size[0],
        height=size[1],
        path=path,
        depth_path=depth_path,
        depth_unit=depth_unit,
        pose_deviation=pose_deviation,
        shrink=shrink,
        lens=intrinsics.lens if distortion_px > IGNORED_PX else None,
        distortion_px=distortion_px,
    )


def streamed(name: str, frames: list[Frame], notes: Sequence[str] = (), *, in_time: bool = False) -> Listing:
    """The frames in the order in which they are streamed, and what is worth telling of them.

    That is the given order where it is known to be that of time, else the natural order of names ("9.jpg" before
    "10.jpg"), unless the given order makes the camera's way less than half as long (names without an order, several
    cameras).
    """
    notes = (*notes, *_notes(frames))
    if in_time:
        return Listing(name=name, frames=tuple(frames), notes=notes)
    ordered = sorted(frames, key=lambda frame: _natural(frame.name))
    if _path_length(frames) < MUCH_SHORTER * _path_length(ordered):
        note = "Frames are streamed in the file's order: by name, the camera would go more than twice as far."
        return Listing(name=name, frames=tuple(frames), notes=(*notes, note))
    return Listing(name=name, frames=tuple(ordered), notes=notes)


def _path_length(frames: list[Frame]) -> float:
    """How far the camera goes from frame to frame."""
    return sum(math.dist(a.center, b.center) for a, b in itertools.pairwise(frames))


def _natural(name: str) -> list[tuple[int, int, str]]:
    """Sort key in which digits count as numbers."""
    parts = re.split(r"([0-9]+)", name)  # every second part is a number
    return [(0, int(part), "") if k % 2 else (1, 0, part) for k, part in enumerate(parts)]


def _notes(frames: list[Frame]) -> tuple[str, ...]:
    notes = []
    off = [f for f in frames if f.pose_deviation > ROTATION_ROUNDING]
    if off:
        worst = max(f.pose_deviation for f in off)
        notes.append(
            f"{len(off)} poses were not quite rotations (by up to {worst:.1e}) and were projected to the nearest."
        )
    if shrinks := {f.shrink for f in frames if f.shrink != 1.0}:
        notes.append(f"Images are {min(shrinks):.4g} times the size of the intrinsics, which were scaled with them.")
    offsets = [max(abs(f.K[0, 2] / f.width - 0.5), abs(f.K[1, 2] / f.height - 0.5)) for f in frames]
    if max(offsets, default=0.0) > FAR_OFF_CENTER:
        notes.append(
            f"The principal point lies {max(offsets):.0%} of a side off the image's center: are the intrinsics those of"
            " images of another size?"
        )
    for what, kind in (("undone", [f for f in frames if f.lens]), ("ignored", [f for f in frames if not f.lens])):
        worst_px = max((f.distortion_px for f in kind), default=0.0)
        if worst_px > 0:
            notes.append(f"Lens distortion of up to {worst_px:.2f} px is {what}.")
    return tuple(notes)
