"""Parts that all readers share, from finding an image to the listing of checked frames in stream order.

A reader hands over what its file says: a name, a pose and intrinsics. `FrameList` finds the images, checks everything
that can be checked without decoding one, and tells the user what was left out.
"""

import contextlib
import dataclasses
import itertools
import math
import posixpath
import re
import unicodedata
from collections.abc import Callable, Sequence
from pathlib import Path, PureWindowsPath
from typing import NamedTuple
from urllib.parse import unquote

import numpy as np
from jaxtyping import Float64

from ssplat_jax.core.cameras import check_matrices
from ssplat_jax.core.errors import echo, reading, refusal
from ssplat_jax.data.images import (
    IGNORED_PX,
    PINHOLE,
    Lens,
    check_depth_header,
    check_lens,
    check_mask,
    image_flags,
    image_size,
    shows_too_little,
)
from ssplat_jax.data.posed_image import (
    MILLIMETER,
    ROTATION_ROUNDING,
    USUAL,
    Convention,
    Frame,
    check_camtoworld,
    check_intrinsics,
    pose_from_quat,
)

SHORTER_PATH_RATIO = 0.5  # camera path in the file's order over that by name, below which the file's order is used
MAX_CENTER_OFFSET = 0.2  # of a side; a principal point farther from the center is reported
SUFFIXES = (".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG", ".webp")  # that are tried behind a name
LISTED = frozenset({".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp"})  # of images, in lower case
MASK_SUFFIXES = (".png", "", "_mask.png", ".mask.png")  # behind the name of an image, its mask
SHRUNK_FOLDERS = ("images_2", "images_4", "images_8")  # downscaled copies of images/, which may be missing


@dataclasses.dataclass(frozen=True, eq=False)
class Listing:
    """Frames of a capture, as a reader found them."""

    name: str
    frames: tuple[Frame, ...]  # in the order of the file; of streaming after `in_stream_order`
    notes: tuple[str, ...] = ()  # messages for the user, one sentence each
    is_in_time: bool = False  # True if that is known to be the order of time


class Reader(NamedTuple):
    """A format of captures."""

    format: str  # its name
    matches: Callable[[Path], bool]  # True if a folder or file is a capture of this format, which may be damaged
    read: Callable[[Path, Convention], Listing]  # reads it, with poses in a convention; raises `InputError`
    convention: Convention = USUAL  # in which its files usually write poses


@dataclasses.dataclass(frozen=True)
class Intrinsics:
    """Intrinsics in pixels of the image that the capture describes; the stored image may be a smaller copy of it."""

    fx: float
    fy: float
    cx: float
    cy: float
    lens: Lens = PINHOLE


def pinhole(matrix: Float64[np.ndarray, "_ _"], where: str, center: float = 0.0) -> Intrinsics:
    """Intrinsics of a matrix, refused if it has skew; `center` is what the first pixel's center lacks to (0.5, 0.5)."""
    with reading(where):
        K = np.array(matrix[:3, :3], np.float64).reshape(3, 3)
    check_matrices(np.eye(4), K, where)
    fx, fy, cx, cy = K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    return Intrinsics(fx=fx, fy=fy, cx=cx + center, cy=cy + center)


class FrameList:
    """Frames of a capture, checked one by one as a reader adds them.

    Args:
        root: folder of the capture.
        convention: in which its file writes poses.
        folder: beginning of the images' paths that the file leaves out, such as "images/".
    """

    def __init__(self, root: Path, convention: Convention = USUAL, folder: str = "") -> None:
        self.root, self.convention, self.folder = root.resolve(), convention, folder
        self.frames: list[Frame] = []
        self._seen: set[object] = set()
        self._by_stem: dict[str, list[Path]] | None = None  # images below images/, found when one is missing
        self._first_missing: tuple[str, str] | None = None  # path and location in the file of an image
        self._renamed = self._turned = 0

    def find(self, name: object, where: str, suffixes: Sequence[str] = ("",)) -> Path | None:
        """The path of the image `name` of the capture, or None if there is no such file.

        Where there is none (`find_image`), the only image of that name in the folders below `images` stands in, else
        the only one with another suffix. Names may be written as in addresses (%20), with accents in either way of
        Unicode, or with the folders of another machine.
        """
        name = self.folder + name if isinstance(name, str) and name else name
        if (image := find_image(self.root, name, where, suffixes)) is not None:
            return image
        assert isinstance(name, str)
        if self._by_stem is None:
            self._by_stem = {}
            for file in images_in(self.root / (images_folder(self.root) or "."), "**/*"):
                if "masks" not in file.relative_to(self.root).parts:
                    self._by_stem.setdefault(unicodedata.normalize("NFC", file.stem), []).append(file)
        wanted = PureWindowsPath(unicodedata.normalize("NFC", unquote(name)))  # splits at both kinds of slashes
        found = self._by_stem.get(wanted.stem, []) + self._by_stem.get(wanted.name, [])
        found = [file for file in found if unicodedata.normalize("NFC", file.name) == wanted.name] or found
        if len(found) == 1:
            self._renamed += 1
            return find_file(self.root, [str(found[0].relative_to(self.root))], where)
        self._first_missing = self._first_missing or (name, where)
        return None

    def named(self, name: object, where: str, suffixes: Sequence[str] = ("",)) -> Path:
        """The path that `find` finds; there must be one."""
        return self.find(name, where, suffixes) or self.file_named(f"{self.folder}{name}", where)

    def file_named(self, name: object, where: str) -> Path:
        """The path that `find_image` finds; there must be one."""
        if (path := find_image(self.root, name, where)) is None:
            got = f"{echo(name)}, where there is none"
            raise refusal(where, wanted="an existing file", got=got, fix="add the file or drop the frame")
        return path

    def add(
        self,
        name: str,
        image: Path,
        pose: object,
        intrinsics: Intrinsics,
        where: str,
        described: tuple[float, float] | None = None,
        *,
        pose_field: str = "",
        key: object = None,
        depth: Path | None = None,
        depth_unit: float = MILLIMETER,
        mask: Path | None = None,
    ) -> None:
        """Adds a frame.

        Args:
            name: of the frame in the capture's files.
            image: its file.
            pose: as the file gives it, in its convention: a matrix, 4x4 or 3x4, or (quaternion wxyz, translation).
            intrinsics: of the image that the capture describes.
            where: location of the frame for messages.
            described: (width, height) of the described image, of which the file may be a smaller copy; None: as stored.
            pose_field: name of the field that holds the pose, for messages.
            key: what only one frame may have; by default the image.
            depth: 16-bit depth image.
            depth_unit: capture units per step of the depth image.
            mask: image that is dark where pixels are masked out; by default one in the folder `masks` of the capture.

        Raises:
            InputError: a value or file is unusable; a link leads outside of the capture; or the frame is there already.
        """
        image = find_file(self.root, [str(image)], str(image)) or image
        key = image if key is None else key
        if key in self._seen:
            raise refusal(where, wanted="every image once", got=f"{echo(name)} again", fix="drop one of the two frames")
        self._seen.add(key)
        if depth is not None:
            check_depth_header(depth)
        if isinstance(pose, tuple):
            quat, translation = pose
            matrix, deviation = pose_from_quat(quat, translation, where), 0.0
        else:
            matrix, deviation = check_camtoworld(pose, where + pose_field)
        (width, height), shrink = stored_size(image, described, where)
        fx, fy, cx, cy = (shrink * x for x in (intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy))
        K = check_intrinsics(fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height, where=where)
        distortion_px = check_lens(intrinsics.lens, K, width, height, where)
        lens = intrinsics.lens if distortion_px > IGNORED_PX else None
        mask = mask or self._mask_of(name, image, where)
        if mask is not None:
            check_mask(mask, image)
        is_transparent, is_turned = image_flags(image)
        self._turned += is_turned
        is_beyond = lens is not None and shows_too_little(lens, K, width, height)
        frame = Frame(
            name,
            self.convention.to_opencv(matrix),
            K,
            width,
            height,
            path=image,
            depth_path=depth,
            depth_unit=depth_unit,
            pose_deviation=deviation,
            shrink=shrink,
            lens=lens,
            distortion_px=distortion_px,
            mask_path=mask,
            is_masked=mask is not None or is_transparent or is_beyond,
        )
        self.frames.append(frame)

    def _mask_of(self, name: str, image: Path, where: str) -> Path | None:
        """The mask of an image in the folder `masks`: its path there, with `.png` behind its suffix or in its place."""
        if not (self.root / "masks").is_dir():
            return None
        places = {name, in_images(name) or name, name.partition("/")[2] or name, image.name}
        stems = sorted(posixpath.splitext(place)[0] for place in places)
        names = [f"masks/{place}{suffix}" for place in sorted(places) for suffix in MASK_SUFFIXES]
        names += [f"masks/{stem}{suffix}" for stem in stems for suffix in (*SUFFIXES, *MASK_SUFFIXES[2:])]
        return find_file(self.root, names, where)

    def listing(
        self, num_listed: int, missing: str, notes: Sequence[str] = (), *, name: str = "", is_in_time: bool = False
    ) -> Listing:
        """The listing, with notes for the user about what was left out and about poses, sizes and intrinsics.

        Captures usually have some frames without a pose or image, so these are counted, and refused only if all are so.

        Args:
            num_listed: number of frames in the file, of which some may not have been added.
            missing: what those that were not added lack, such as "image".
            notes: further messages for the user.
            name: of the capture; by default that of its folder.
            is_in_time: True if frames were added in the order of time.
        """
        lost = num_listed - len(self.frames)
        if not self.frames and self._first_missing is not None:
            self.file_named(*self._first_missing)  # refuses it
        if not self.frames:
            got = f"none of {num_listed} with its {missing}"
            raise refusal(str(self.root), wanted="frames with images and poses", got=got, fix="complete the capture")
        left_out = [f"{lost} of {num_listed} frames are skipped: their {missing} is missing."] if lost else []
        if self._renamed:
            what = f"{self._renamed} images were found in another folder or with another suffix than the poses name."
            left_out.append(what)
        if self._turned:
            what = f"{self._turned} images have an EXIF orientation, which is not applied"
            left_out.append(f"{what}: intrinsics and poses must be those of the pixels as they are stored.")
        used = {frame.mask_path for frame in self.frames}
        if unused := sum(mask.resolve() not in used for mask in images_in(self.root / "masks", "**/*")):
            left_out.append(f"{unused} files in masks/ are left out: no image has their name (1.png masks 1.jpg).")
        notes = (*left_out, *notes, *_notes(self.frames))
        return Listing(name or self.root.name, tuple(self.frames), notes, is_in_time)


def in_stream_order(listing: Listing) -> Listing:
    """A listing with its frames in the order of streaming.

    Frames are sorted by name in natural order ("9.jpg" before "10.jpg"). The order of the file is kept if it is the
    order of time, or if it makes the path of the camera less than half as long, as with random names or several
    cameras.
    """
    if listing.is_in_time:
        return listing
    ordered = tuple(sorted(listing.frames, key=lambda frame: natural(frame.name)))
    if _path_length(listing.frames) < SHORTER_PATH_RATIO * _path_length(ordered):
        note = "Frames are streamed in the file's order: by name, the camera path would be more than twice as long."
        return dataclasses.replace(listing, notes=(*listing.notes, note))
    return dataclasses.replace(listing, frames=ordered)


def _path_length(frames: Sequence[Frame]) -> float:
    return sum((math.dist(a.center, b.center) for a, b in itertools.pairwise(frames)), 0.0)


def natural(name: str) -> list[tuple[int, int, str]]:
    """The key of a name by which to sort: runs of digits count as numbers."""
    parts = re.split(r"([0-9]+)", name)  # parts with an odd index are digits
    return [(0, int(part), "") if k % 2 else (1, 0, part) for k, part in enumerate(parts)]


def _notes(frames: list[Frame]) -> list[str]:
    """Notes for the user about deviations of poses, sizes and intrinsics."""
    notes = []
    off = [f.pose_deviation for f in frames if f.pose_deviation > ROTATION_ROUNDING]
    if off:
        worst = f"off by up to {max(off):.1e}"
        notes.append(f"{len(off)} poses were not exact rotations ({worst}); the nearest ones are used.")
    if shrinks := {f.shrink for f in frames if f.shrink != 1.0}:
        notes.append(f"Images are {min(shrinks):.4g} times the size of the intrinsics, which were scaled with them.")
    offset = max(max(abs(f.K[0, 2] / f.width - 0.5), abs(f.K[1, 2] / f.height - 0.5)) for f in frames)
    if offset > MAX_CENTER_OFFSET:
        where = f"{offset:.0%} of a side off the image's center"
        notes.append(f"The principal point lies {where}; check that the intrinsics belong to images of this size.")
    if masked := sum(frame.mask_path is not None for frame in frames):
        notes.append(f"{masked} of {len(frames)} frames have masks: what they hide is neither streamed nor scored.")
    if sum(frame.is_masked for frame in frames) > masked:
        notes.append("Transparent pixels, and those beyond the border of distorted images, do not count.")
    for what, pixels in (
        ("undone", [f.distortion_px for f in frames if f.lens]),
        ("ignored", [f.distortion_px for f in frames if not f.lens]),
    ):
        if max(pixels, default=0.0) > 0:
            notes.append(f"Lens distortion of up to {max(pixels):.2f} px is {what}.")
    return notes


# -- files ------------------------------------------------------------------------------------------------------------


def find_file(root: Path, names: Sequence[str], where: str) -> Path | None:
    """The first of `names` that is a file in the folder `root`, after symbolic links are resolved, or None.

    Names that lead outside `root` are refused: a capture from elsewhere must not make us read other files. A folder of
    the capture may itself be a link, as `images` often is.
    """
    for name in names:
        try:
            path = (root / name).resolve()
            found = path.is_file()
        except (OSError, RuntimeError, ValueError):  # name too long, loop of links
            continue
        if not found:  # also a path of another machine
            continue
        if not path.is_relative_to(root) and not any(path.is_relative_to(folder) for folder in _linked(root)):
            fix = "copy the file into the capture's folder and give its relative path"
            raise refusal(where, wanted=f"a path inside {root}", got=echo(name), fix=fix)
        return path
    return None


def _linked(root: Path) -> list[Path]:
    """The folders elsewhere to which links in the folder `root` lead."""
    with contextlib.suppress(OSError):
        return [folder.resolve() for folder in root.iterdir() if folder.is_symlink() and folder.is_dir()]
    return []


def name_in(root: Path, image: Path) -> str:
    """The path of an image relative to the folder `root`, or its name if a link leads to it."""
    return str(image.relative_to(root)) if image.is_relative_to(root) else image.name


def find_image(root: Path, name: object, where: str, suffixes: Sequence[str] = ("",)) -> Path | None:
    """The path of the image `name` of the capture, or None if there is no such file.

    The `suffixes` are tried behind the name; backslashes count as slashes. A downscaled copy (images_2, ...) stands in
    for an image that is missing in images/; any of `SUFFIXES` may stand in place of its own there.
    """
    if not isinstance(name, str) or not name or "\0" in name:
        raise refusal(where, wanted="the path of a file", got=echo(name), fix="give it relative to the capture")
    below, slashed = in_images(name), [name.replace("\\", "/")] if "\\" in name else []
    copies = [] if below is None else [f"{folder}/{below}" for folder in SHRUNK_FOLDERS]
    renamed = [posixpath.splitext(copy)[0] + suffix for copy in copies for suffix in SUFFIXES]
    return find_file(root, [n + suffix for n in (name, *slashed, *copies) for suffix in suffixes] + renamed, where)


def in_images(name: str) -> str | None:
    """The part of a file name after images/ (or ./images/), or None for files elsewhere."""
    plain = posixpath.normpath(name)
    return plain.removeprefix("images/") if plain.startswith("images/") else None


def images_folder(root: Path) -> str:
    """Returns "images/" if the capture keeps its images there or in downscaled copies of it, else nothing."""
    return "images/" if any((root / name).is_dir() for name in ("images", *SHRUNK_FOLDERS)) else ""


def files_in(folder: Path, pattern: str = "*") -> list[Path]:
    """The files of a folder in the order of their names; none if there is no such folder.

    Hidden files are left out: those that macOS writes beside images (`._1.jpg`) have the images' suffixes.
    """
    return sorted(file for file in folder.glob(pattern) if file.is_file() and not file.name.startswith("."))


def images_in(folder: Path, pattern: str = "*") -> list[Path]:
    """The image files of a folder, in the order of their names."""
    return [file for file in files_in(folder, pattern) if file.suffix.lower() in LISTED]


def files_with(path: Path, suffix: str, *patterns: bytes) -> list[Path]:
    """The file at `path`, or those in that folder, with a suffix and all `patterns` in the first 2,000 bytes."""
    files = [path] if path.is_file() else files_in(path, f"*{suffix}")
    found = []
    for file in files:
        if file.suffix == suffix:
            with file.open("rb") as opened:
                start = opened.read(2000)
            found += [file] if all(re.search(pattern, start) for pattern in patterns) else []
    return found


def stored_size(image: Path, described: tuple[float, float] | None, where: str) -> tuple[tuple[int, int], float]:
    """(width, height) of a stored image, and its size relative to the described one.

    Downscaled copies (images_2, images_4) are described by the intrinsics of the full size. An image counts as such a
    copy if both sides are smaller by the same factor, to a pixel; others are refused. `described` is None if the
    capture does not say a size.
    """
    size = image_size(image)
    if described in (None, size):
        return size, 1.0
    shrink = max(size) / max(*described, 1e-9)  # rounding affects the longer side less
    if shrink < 1 and all(abs(w * shrink - side) <= 1.0 for w, side in zip(described, size, strict=True)):
        return size, shrink
    fix = "use the images that the capture describes, or scale its intrinsics with the size"
    if described == size[::-1]:
        fix = "the image lies on its side: rotate the file (EXIF orientation is not applied) or swap the intrinsics"
    got = f"{size[0]}x{size[1]} in {image.name}"
    raise refusal(where, wanted=f"an image of {described[0]:g}x{described[1]:g}", got=got, fix=fix)
