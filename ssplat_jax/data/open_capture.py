"""`open_capture`: posed images from a folder or a procedural scene, checked when they are opened.

Opening a capture reads poses, intrinsics and image headers; images are decoded on request.
"""

import contextlib
import dataclasses
import shlex
from pathlib import Path

import numpy as np

from ssplat_jax.core.errors import InputError, echo, reading, refusal
from ssplat_jax.core.kept_programs import kept_result
from ssplat_jax.data.capture import MAX_SIDE, ArrayPixels, Capture, FilePixels, capture_of_listing
from ssplat_jax.data.images import MAX_PIXELS
from ssplat_jax.data.posed_image import Frame, check_camtoworld, split_options
from ssplat_jax.data.readers import CAPTURE_READERS
from ssplat_jax.data.readers.frame_list import LISTED, Listing, files_in, in_stream_order
from ssplat_jax.data.readers.transforms_json import TRANSFORMS_JSON, read_transforms

UNREADABLE_SUFFIXES = frozenset({".heic", ".heif", ".avif", ".jxl"})  # what phones write and we do not read
IMAGE_SUFFIXES = LISTED | UNREADABLE_SUFFIXES
"""Images in a folder of these lack only their poses."""
ARCHIVES = frozenset({".zip", ".r3d", ".tar", ".gz", ".tgz", ".7z", ".rar"})
VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".mkv", ".webm"})
PROCEDURAL = "procedural"  # scheme of the paths of procedural captures
PROCEDURAL_OPTIONS = {"frames": (), "size": (), "seed": (), "depth": ("on", "off")}
PROCEDURAL_FRAMES = 73  # 64 context views and the 9 interleaved targets between them
PROCEDURAL_SIZE = (128, 96)  # (width, height), at which the demo takes about a minute on two cores
DONE = "done"  # a file of this name in the folder of a growing capture says that nothing more will come


def open_capture(path: str | Path, *, size: tuple[int, int] | None = None) -> Capture:
    """Opens the capture at `path`.

    Args:
        path: a folder or file in one of the formats of `data.readers`, or a procedural scene (room, laps, orbit,
            corridor, revisit), such as `procedural:room?frames=73&size=128x96&seed=0`. Poses that do not follow the
            convention of their format are read with options behind it: `folder?axes=opengl&poses=world-to-camera`.
            Depth maps of a folder are streamed with its images, unless `folder?depth=off` says no; those of a
            procedural scene are exact, and are streamed only with `depth=on`.
        size: (width, height) of delivered images. Stored images are scaled to cover it and cropped at the center, and
            the intrinsics follow exactly. By default the size of the stored images.

    Raises:
        InputError: there is no capture at `path`, or a file or field of it is unusable; the message names it.
    """
    if size is not None and not (all(1 <= side <= MAX_SIDE for side in size) and size[0] * size[1] <= MAX_PIXELS):
        wanted = f"sides of 1 to {MAX_SIDE} and at most {MAX_PIXELS:,} pixels"
        raise refusal("size", wanted=wanted, got=echo(size), fix="give WIDTHxHEIGHT in pixels")
    if str(path).startswith(f"{PROCEDURAL}:"):
        return _open_procedural(str(path), size)
    path, options = split_options(str(path))
    folder = without_tilde(path)
    with reading(path[:80], "check the path"):  # name too long, no permission
        found = next((reader for reader in CAPTURE_READERS if reader.matches(folder)), None)
        exists = folder.exists()
    if found is None:
        raise _no_capture(path, folder, exists=exists)
    streams_depth = options.pop("depth", "on") == "on"
    convention = dataclasses.replace(found.convention, **options)
    listing = in_stream_order(found.read(folder, convention))
    capture = capture_of_listing(listing, found.format, FilePixels(listing.frames), size, convention)
    return dataclasses.replace(capture, streams_depth=streams_depth)


def without_tilde(path: str) -> Path:
    """`path` with the home folder in place of a leading `~` or `~user`, which must exist."""
    with reading(path[:80], "check the path"):
        return Path(path).expanduser()


def is_capture(path: Path) -> bool:
    """True if a reader takes `path`: it looks like a capture, which may still be damaged."""
    return any(reader.matches(path) for reader in CAPTURE_READERS)


def _no_capture(path: str, folder: Path, *, exists: bool) -> InputError:
    """The refusal of a path that no reader takes, with what is there in place of a capture."""
    fix = "check the path"
    if not exists:
        got = "a link that leads nowhere" if folder.is_symlink() else "nothing of that name"
    elif folder.is_dir() and not any(folder.iterdir()):
        got = "an empty folder"
    elif folder.suffix.lower() in ARCHIVES:
        got, fix = "an archive", "unpack it, and give the folder"
    elif inner := _capture_in(folder):
        got, fix = "none of these", f"give the folder in it: {inner}"
    elif unposed := _unposed(folder):
        kind, source = unposed
        got = f"none of these, but {kind} without camera poses"
        example = shlex.join(["ssplat", "poses", str(source), "--out", f"{source.stem or 'my'}_capture"])
        fix = f"estimate the poses first: {example} (COLMAP by pycolmap), and give the folder that it writes"
    else:
        got, fix = "none of these", f"see --help of `ssplat inspect` for their files, or try {PROCEDURAL}:room"
    formats = ", ".join(reader.format for reader in CAPTURE_READERS)
    return refusal(path, wanted=f"a posed capture ({formats})", got=got, fix=fix)


def _capture_in(folder: Path) -> Path | None:
    """The first folder in a folder that is a capture."""
    with contextlib.suppress(OSError):  # no folder, or no permission
        return next((child for child in sorted(folder.iterdir()) if child.is_dir() and is_capture(child)), None)
    return None


def _unposed(path: Path) -> tuple[str, Path] | None:
    """The kind of images that a path holds without poses, "images" or "a video", and where they are; or None."""
    if path.is_file():
        return ("a video", path) if path.suffix.lower() in VIDEO_SUFFIXES else None
    files = [file for folder in (path, path / "images") for file in files_in(folder)]
    if any(file.suffix.lower() in IMAGE_SUFFIXES for file in files):
        return "images", path
    return next((("a video", file) for file in files if file.suffix.lower() in VIDEO_SUFFIXES), None)


# -- captures that are still being written ----------------------------------------------------------------------------


def open_growing(path: Path, *, size: tuple[int, int] | None) -> tuple[Capture | None, str | None]:
    """Opens what is there of a capture: a transforms.json that grows, and images that may not be complete.

    Args:
        path: folder that holds, or will hold, a transforms.json.
        size: (width, height) of delivered images; by default that of the stored ones.

    Returns:
        The capture of the frames before the first whose image or fields cannot be read, None if there is no such frame;
        and why no more of them can be read, None if all can. An image is complete when it can be decoded.
    """
    problems: list[str] = []
    try:
        listing = in_stream_order(read_transforms(path, TRANSFORMS_JSON.convention, problems))
        pixels, convention = FilePixels(listing.frames), TRANSFORMS_JSON.convention
        capture = capture_of_listing(listing, TRANSFORMS_JSON.format, pixels, size, convention)
        return capture, problems[0] if problems else None
    except InputError as error:  # missing, or being written
        return None, str(error)


# -- procedural scenes ------------------------------------------------------------------------------------------------


def _open_procedural(spec: str, size: tuple[int, int] | None) -> Capture:
    """The procedural capture of a path, rendered immediately; `size` is that of images where `spec` has none."""
    path, options = split_options(spec, PROCEDURAL_OPTIONS)
    name = path.removeprefix(f"{PROCEDURAL}:")
    num_frames = _whole(spec, "frames", options.get("frames", str(PROCEDURAL_FRAMES)), 1, 100_000)
    seed = _whole(spec, "seed", options.get("seed", "0"), 0, 2**31 - 1)
    width, height = size or PROCEDURAL_SIZE
    if "size" in options:
        sides = options["size"].lower().split("x")
        if len(sides) != 2:
            raise refusal(f"{spec}: size", wanted="WIDTHxHEIGHT", got=echo(options["size"]), fix="write 128x96")
        width, height = (_whole(spec, "size", side, 8, MAX_SIDE) for side in sides)
    # Imported here because the scenes load their textures, which no other capture needs.
    from ssplat_jax.data.procedural.procedural_views import procedural_capture_arrays

    wanted = (name, num_frames, height, width, seed)
    images, depths, camtoworlds, Ks = kept_result(lambda: procedural_capture_arrays(*wanted), "views", *wanted)
    frames = tuple(
        Frame(f"{name}/{i:05d}", check_camtoworld(pose, spec)[0], K.astype(np.float64), width, height)
        for i, (pose, K) in enumerate(zip(camtoworlds, Ks, strict=True))
    )
    pixels = ArrayPixels(images=np.asarray(images, np.float32), depths=np.asarray(depths, np.float32))
    title = f"{PROCEDURAL}-{name}" + (f"-seed{seed}" if seed else "")
    capture = capture_of_listing(Listing(name=title, frames=frames), PROCEDURAL, pixels, size)
    return dataclasses.replace(capture, streams_depth=options.get("depth") == "on")


def _whole(spec: str, option: str, text: str, low: int, high: int) -> int:
    """Parses an option of a procedural path as a whole number in [low, high]."""
    if text.isascii() and text.isdigit() and len(text) < 12 and low <= int(text) <= high:
        return int(text)
    wanted = f"a whole number in [{low}, {high}]"
    raise refusal(f"{spec}: {option}", wanted=wanted, got=echo(text), fix="change the option")
