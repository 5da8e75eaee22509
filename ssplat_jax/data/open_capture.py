"""`open_capture`: posed images from a folder or a procedural scene, checked when they are opened.

Opening a capture reads poses, intrinsics and image headers; images are decoded on request.
"""

import dataclasses
import shlex
from pathlib import Path

from ssplat_jax.core.errors import InputError, echo, refusal
from ssplat_jax.data.capture import MAX_SIDE, Capture, capture_of_listing
from ssplat_jax.data.images import MAX_PIXELS, FilePixels
from ssplat_jax.data.pose_conventions import USUAL, reinterpreted, split_options
from ssplat_jax.data.procedural_capture import PROCEDURAL, open_procedural
from ssplat_jax.data.readers import (
    colmap,
    kitti,
    llff,
    polycam,
    realestate10k,
    record3d,
    scannet,
    splat_cameras,
    transforms_json,
    tum,
)
from ssplat_jax.data.readers.frame_list import in_stream_order

READERS = (  # the first one that matches reads the capture
    transforms_json,
    colmap,
    polycam,
    record3d,
    llff,
    scannet,
    tum,
    kitti,
    realestate10k,
    splat_cameras,
)
UNREADABLE_SUFFIXES = frozenset({".heic", ".heif"})  # what phones write and Pillow does not read
IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp"}) | UNREADABLE_SUFFIXES
"""Images in a folder of these lack only their poses."""
VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".mkv", ".webm"})


def open_capture(path: str | Path, *, size: tuple[int, int] | None = None) -> Capture:
    """Opens the capture at `path`.

    Args:
        path: a folder or file in one of the formats of `data.readers`, or a procedural scene (room, orbit, corridor,
            revisit), such as `procedural:room?frames=73&size=128x96&seed=0`. Poses that do not follow the convention of
            their format are read with options behind it: `folder?axes=opengl&poses=world-to-camera`.
        size: (width, height) of delivered images. Stored images are scaled to cover it and cropped at the center, and
            the intrinsics follow exactly. By default the size of the stored images.

    Raises:
        InputError: there is no capture at `path`, or a file or field of it is unusable; the message names it.
    """
    if size is not None and not all(1 <= side <= MAX_SIDE for side in size):
        raise refusal("size", wanted=f"sides of 1 to {MAX_SIDE}", got=echo(size), fix="give WIDTHxHEIGHT in pixels")
    if size is not None and size[0] * size[1] > MAX_PIXELS:
        wanted = f"at most {MAX_PIXELS:,} pixels"
        raise refusal("size", wanted=wanted, got=f"{size[0]}x{size[1]}", fix="ask for a smaller one")
    if str(path).startswith(f"{PROCEDURAL}:"):
        return open_procedural(str(path), size)
    path, options = split_options(str(path))
    folder = without_tilde(path)
    try:
        found = next((reader for reader in READERS if reader.matches(folder)), None)
        exists = folder.exists()
    except (OSError, ValueError) as error:  # name too long, no permission
        raise _no_path(path, error) from None
    if found is not None:
        usual = getattr(found, "CONVENTION", USUAL)
        written = dataclasses.replace(usual, **options)
        listing = found.read(folder)
        frames = tuple(reinterpreted(frame, usual, written) for frame in listing.frames)
        listing = in_stream_order(dataclasses.replace(listing, frames=frames if options else listing.frames))
        return capture_of_listing(listing, found.FORMAT, FilePixels(listing.frames), size, written)
    if not exists:
        got = "a link that leads nowhere" if folder.is_symlink() else "nothing of that name"
        fix = "check the path"
    elif folder.is_dir() and not any(folder.iterdir()):
        got, fix = "an empty folder", "check the path"
    elif unposed := _unposed(folder):
        kind, source = unposed
        got = f"none of these, but {kind} without camera poses"
        example = shlex.join(["ssplat", "poses", str(source), "--out", f"{source.stem or 'my'}_capture"])
        fix = f"estimate the poses first: {example} (COLMAP by pycolmap), and give the folder that it writes"
    else:
        got, fix = "none of these", f"see --help of `ssplat inspect` for their files, or try {PROCEDURAL}:room"
    formats = ", ".join(reader.FORMAT for reader in READERS)
    raise refusal(str(path), wanted=f"a posed capture ({formats})", got=got, fix=fix)


def without_tilde(path: str) -> Path:
    """`path` with the home folder in place of a leading `~` or `~user`.

    Raises:
        InputError: there is no such user.
    """
    try:
        return Path(path).expanduser()
    except (RuntimeError, ValueError) as error:
        raise _no_path(path, error) from None


def _no_path(path: str, error: Exception) -> InputError:
    return refusal(str(path)[:80], wanted="a path", got=str(error)[:200], fix="check the path")


def is_capture(path: Path) -> bool:
    """True if a reader takes `path`: it looks like a capture, which may still be damaged."""
    return any(reader.matches(path) for reader in READERS)


def _unposed(path: Path) -> tuple[str, Path] | None:
    """The kind of images that a path holds without poses, "images" or "a video", and where they are; or None."""
    if path.is_file():
        return ("a video", path) if path.suffix.lower() in VIDEO_SUFFIXES else None
    files = [file for folder in (path, path / "images") if folder.is_dir() for file in sorted(folder.iterdir())]
    if any(file.suffix.lower() in IMAGE_SUFFIXES for file in files):
        return "images", path
    return next((("a video", file) for file in files if file.suffix.lower() in VIDEO_SUFFIXES), None)
