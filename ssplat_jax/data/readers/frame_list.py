"""Steps that all readers share: finding files, checking a frame, and listing and ordering the frames."""

import dataclasses
import errno
import itertools
import math
import posixpath
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from ssplat_jax.core.errors import echo, refusal
from ssplat_jax.data.images import image_size
from ssplat_jax.data.lens import IGNORED_PX, PINHOLE, Lens, check_lens
from ssplat_jax.data.posed_image import MILLIMETER, ROTATION_ROUNDING, Frame, check_intrinsics
from ssplat_jax.data.readers import Listing

SHORTER_PATH_RATIO = 0.5  # camera path in the file's order over that by name, below which the file's order is used
MAX_CENTER_OFFSET = 0.2  # of a side; a principal point farther from the center is reported
EXTENSIONS = ("", ".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG", ".webp")
SHRUNK_FOLDERS = ("images_2", "images_4", "images_8")  # downscaled copies of images/, which may be missing


@dataclasses.dataclass(frozen=True)
class Intrinsics:
    """Intrinsics in pixels of the image that the capture describes; the stored image may be a smaller copy of it."""

    fx: float
    fy: float
    cx: float
    cy: float
    lens: Lens = PINHOLE


def find_file(root: Path, names: Sequence[str], where: str) -> Path | None:
    """Returns the first of `names` that is a file in the folder `root`, after symbolic links are resolved, or None.

    Raises:
        InputError: a name leads outside `root`; the message starts with `where`.
    """
    for name in names:
        try:
            path = (root / name).resolve()
            found = path.is_file()
        except (OSError, RuntimeError, ValueError):  # name too long, loop of links
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
    """Returns the path of the file `name` of the capture; `find_named` has the arguments.

    Raises:
        InputError: there is no such file, or it is outside `root`.
    """
    path = find_named(root, name, where, extensions, folders)
    if path is None:
        names = _names_of(str(name), folders)
        got = f"{echo(name)}, which {_missing(root, names, extensions)}"
        raise refusal(where, wanted="an existing file", got=got, fix="add the file or drop the frame")
    return path


def find_named(
    root: Path, name: object, where: str, extensions: tuple[str, ...] = ("",), folders: tuple[str, ...] = ()
) -> Path | None:
    """Returns the path of the file `name` of the capture, or None if there is no such file.

    Args:
        root: folder of the capture.
        name: path relative to `root`, not yet checked.
        where: location of the name for error messages.
        extensions: extensions to try.
        folders: folders to try in place of images/; there, any of `EXTENSIONS` may stand in place of the name's own.

    Returns:
        The resolved path, or None.

    Raises:
        InputError: `name` is no path, or leads outside `root`.
    """
    if not isinstance(name, str) or not name or "\0" in name:
        raise refusal(where, wanted="the path of a file", got=echo(name), fix="give it relative to the capture")
    names = _names_of(name, folders)
    path = find_file(root, [n + extension for n in names for extension in extensions], where)
    if path is None:
        stems = [n[: len(n) - len(posixpath.splitext(n)[1])] for n in names[1:]]
        path = find_file(root, [stem + extension for stem in stems for extension in EXTENSIONS[1:]], where)
    return path


def _names_of(name: str, folders: Sequence[str]) -> list[str]:
    """The name, and its places in `folders` if it is in images/."""
    below = in_images(name)
    return [name, *(f"{folder}/{below}" for folder in folders if below is not None)]


def _missing(root: Path, names: Sequence[str], extensions: Sequence[str]) -> str:
    """The reason why none of the names, with any of the extensions, is a file, as the end of a sentence."""
    for path in (root / (name + extension) for name in names for extension in extensions):
        try:
            if path.is_dir():
                return "is a folder"
            if path.is_symlink():
                path.resolve(strict=True)
        except FileNotFoundError:
            return "is a link to a file that does not exist"
        except (OSError, RuntimeError, ValueError) as error:  # Python 3.13 and later raise OSError for a loop of links
            if isinstance(error, RuntimeError) or getattr(error, "errno", None) == errno.ELOOP:
                return "is a link that leads back to itself"
    return "does not exist"


def check_once(seen: dict[Path, str], path: Path, name: str, where: str) -> None:
    """Checks that no frame before has the same image, and adds it to `seen`.

    Args:
        seen: location of the first frame of each image.
        path: the image.
        name: its name in the capture's files.
        where: location of the frame for error messages.

    Raises:
        InputError: the image is in `seen`.
    """
    first = seen.setdefault(path, where)
    if first is not where:
        got = f"{echo(name)} again, after {first.split(': ')[-1]}"
        raise refusal(where, wanted="every image once", got=got, fix="drop one of the two frames")


def in_images(name: str) -> str | None:
    """Returns the part of a file name after images/ (or ./images/), or None for files elsewhere."""
    plain = posixpath.normpath(name)
    return plain.removeprefix("images/") if plain.startswith("images/") else None


def stored_size(path: Path, described: tuple[float, float], where: str, fix: str) -> tuple[tuple[int, int], float]:
    """Returns (width, height) of a stored image, and its size relative to the described one.

    Downscaled copies (images_2, images_4) are described by the intrinsics of the full size. An image counts as such a
    copy if both sides are smaller by the same factor, to a pixel.

    Args:
        path: the image.
        described: (width, height) in the capture's files.
        where: location of that size for error messages.
        fix: remedy for error messages.

    Returns:
        The size of the stored image, and a factor of at most 1.

    Raises:
        InputError: the image is neither of the described size nor a downscaled copy.
    """
    width, height = image_size(path)
    if described == (width, height):
        return (width, height), 1.0
    shrink = max(width, height) / max(*described, 1e-9)  # rounding affects the longer side less
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
    """Returns a frame with checked intrinsics.

    Args:
        name: name of the frame in the capture's files.
        path: the image.
        camtoworld: checked pose with OpenCV axes.
        intrinsics: intrinsics of the described image.
        size: (width, height) of the stored image.
        where: location of the intrinsics for error messages.
        pose_deviation: |R^T R - I| of the pose as given.
        shrink: size of the stored image relative to the described one.
        depth_path: 16-bit depth image.
        depth_unit: capture units per step of the depth image.

    Returns:
        The frame.

    Raises:
        InputError: the intrinsics are implausible, or the distortion folds the image.
    """
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


def list_frames(name: str, frames: list[Frame], notes: Sequence[str] = (), *, is_in_time: bool = False) -> Listing:
    """Returns the listing of a reader, with notes for the user about poses, sizes and intrinsics.

    Args:
        name: name of the capture.
        frames: frames in the order of the file.
        notes: further messages for the user.
        is_in_time: True if `frames` are in the order of time.
    """
    return Listing(name=name, frames=tuple(frames), notes=(*notes, *_notes(frames)), is_in_time=is_in_time)


def in_stream_order(listing: Listing) -> Listing:
    """Returns a listing with its frames in the order of streaming.

    Frames are sorted by name in natural order ("9.jpg" before "10.jpg"). The order of the file is kept if it is the
    order of time, or if it makes the path of the camera less than half as long, as with random names or several
    cameras. The path needs true centers: call it after `reinterpreted`.
    """
    if listing.is_in_time:
        return listing
    ordered = tuple(sorted(listing.frames, key=lambda frame: _natural(frame.name)))
    if _path_length(listing.frames) < SHORTER_PATH_RATIO * _path_length(ordered):
        note = "Frames are streamed in the file's order: by name, the camera path would be more than twice as long."
        return dataclasses.replace(listing, notes=(*listing.notes, note))
    return dataclasses.replace(listing, frames=ordered)


def _path_length(frames: Sequence[Frame]) -> float:
    """Length of the camera path."""
    return sum((math.dist(a.center, b.center) for a, b in itertools.pairwise(frames)), 0.0)


def _natural(name: str) -> list[tuple[int, int, str]]:
    """Sort key that compares runs of digits as numbers."""
    parts = re.split(r"([0-9]+)", name)  # parts with an odd index are digits
    return [(0, int(part), "") if k % 2 else (1, 0, part) for k, part in enumerate(parts)]


def _notes(frames: list[Frame]) -> tuple[str, ...]:
    """Notes for the user about deviations of poses, sizes and intrinsics."""
    notes = []
    off = [f for f in frames if f.pose_deviation > ROTATION_ROUNDING]
    if off:
        worst = max(f.pose_deviation for f in off)
        notes.append(
            f"{len(off)} poses were not exact rotations (off by up to {worst:.1e}); the nearest ones are used."
        )
    if shrinks := {f.shrink for f in frames if f.shrink != 1.0}:
        notes.append(f"Images are {min(shrinks):.4g} times the size of the intrinsics, which were scaled with them.")
    offsets = [max(abs(f.K[0, 2] / f.width - 0.5), abs(f.K[1, 2] / f.height - 0.5)) for f in frames]
    if max(offsets, default=0.0) > MAX_CENTER_OFFSET:
        notes.append(
            f"The principal point lies {max(offsets):.0%} of a side off the image's center; check that the"
            " intrinsics belong to images of this size."
        )
    for what, kind in (("undone", [f for f in frames if f.lens]), ("ignored", [f for f in frames if not f.lens])):
        worst_px = max((f.distortion_px for f in kind), default=0.0)
        if worst_px > 0:
            notes.append(f"Lens distortion of up to {worst_px:.2f} px is {what}.")
    return tuple(notes)
