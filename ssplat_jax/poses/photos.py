"""Photos: a folder of image files becomes upright copies of bounded size, all that structure from motion reads."""

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image
from PIL.ExifTags import IFD, Base

from ssplat_jax.core.errors import echo, refusal
from ssplat_jax.data.images import DEPTH_MODES, ORIENTATION, UPRIGHT, image_size
from ssplat_jax.data.open_capture import IMAGE_SUFFIXES, UNREADABLE_SUFFIXES

JPEG_QUALITY = 95
TURNS = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
"""Transpositions that bring photos upright, by the EXIF orientation."""
MAX_EXIF_BYTES = 65_533
"""Longest EXIF data of a JPEG file."""
FOCAL_TAGS = (
    Base.FocalLength,
    Base.FocalLengthIn35mmFilm,
    Base.FocalPlaneXResolution,
    Base.FocalPlaneYResolution,
    Base.FocalPlaneResolutionUnit,
    Base.ExifImageWidth,
    Base.ExifImageHeight,
)
"""EXIF tags from which COLMAP takes the focal length."""
SUFFIXES = IMAGE_SUFFIXES - UNREADABLE_SUFFIXES


def list_photos(folder: Path) -> list[Path]:
    """Returns the photos in a folder, or in its `images/`, in the order of names in which digits count as numbers.

    Raises:
        InputError: there are fewer than two, or one is of a kind that is not read and has no readable copy beside it.
    """
    for place in (folder, folder / "images"):
        files = sorted(place.iterdir(), key=_natural) if place.is_dir() else []
        photos = [file for file in files if file.suffix.lower() in SUFFIXES and file.is_file()]
        readable = {file.stem for file in photos}
        phone = [f for f in files if f.suffix.lower() in UNREADABLE_SUFFIXES and f.stem not in readable]
        if phone:
            got = f"{len(phone)} HEIC files" + (f" beside {len(photos)} others" if photos else "")
            fix = "convert them to JPEG first (the phone's camera settings call JPEG `most compatible`)"
            raise refusal(str(place), wanted="JPEG or PNG photos", got=got, fix=fix)
        if len(photos) > 1:
            return photos
    kinds = ", ".join(sorted(SUFFIXES))
    fix = f"give the folder that holds them ({kinds}), or a video file"
    raise refusal(str(folder), wanted="a folder of photos", got="fewer than two images", fix=fix)


def copy_photos(photos: list[Path], folder: Path, max_side: int, advance: Callable[[int], None]) -> list[str]:
    """Copies photos into `folder`: as they are where they are upright and small enough, otherwise as JPEG files.

    Args:
        photos: the files.
        folder: existing folder of the copies.
        max_side: longer side of larger images is reduced to so many pixels.
        advance: called with the number of files so far.

    Returns:
        The names of the copies. An underscore stands for each space, for a `#` at the start, which would begin a
        comment in COLMAP's lists, and for what is not UTF-8.

    Raises:
        InputError: a file is no readable image, or two names differ in these characters alone.
    """
    names: list[str] = []
    for photo in photos:
        size = image_size(photo)
        name = re.sub(r"\s|^#|[\ud800-\udfff]", "_", photo.name)  # Python writes other bytes as surrogates
        with Image.open(photo) as picture:
            _load(picture, photo)
            orientation, exif = _exif_of(picture)
            is_upright = orientation == UPRIGHT
            if not (is_upright and max(size) <= max_side):
                name = Path(name).stem + ".jpg"
            if name in names:
                fix = "rename one of the two"
                raise refusal(str(photo), wanted="every name once", got=f"{echo(name)} twice", fix=fix)
            names.append(name)
            if is_upright and max(size) <= max_side:
                shutil.copyfile(photo, folder / name)
            else:
                upright = picture if is_upright else picture.transpose(TURNS[orientation])
                save_upright(upright, folder / name, max_side, exif=exif)
        advance(len(names))
    return names


def _exif_of(picture: Image.Image) -> tuple[int, bytes]:
    """Orientation of a photo, and its EXIF data without it, in which structure from motion reads the focal length.

    Malformed data, as some cameras write them, count as none; an orientation that can be read is kept.
    """
    orientation = UPRIGHT
    try:
        exif = picture.getexif()
        if exif.get(ORIENTATION) in TURNS:
            orientation = exif[ORIENTATION]
        exif.pop(ORIENTATION, None)
        data = exif.tobytes()
        if len(data) > MAX_EXIF_BYTES:
            data = _camera_tags(exif).tobytes()
        return orientation, data if len(data) <= MAX_EXIF_BYTES else b""
    except Exception:  # Pillow's parser raises nearly anything on damaged data
        return orientation, b""


def _camera_tags(exif: Image.Exif) -> Image.Exif:
    """The camera's name and focal length of EXIF data that are too long for a JPEG file."""
    kept, inner = Image.Exif(), exif.get_ifd(IFD.Exif)
    kept.update({tag: exif[tag] for tag in (Base.Make, Base.Model) if tag in exif})
    kept[IFD.Exif] = {tag: inner[tag] for tag in FOCAL_TAGS if tag in inner}
    return kept


def _load(picture: Image.Image, photo: Path) -> None:
    """Decodes a photo, so that a damaged one is refused before hours of matching."""
    try:
        picture.load()
    except Exception as error:  # Pillow's decoders raise nearly anything on damaged data
        got = f"damaged data ({' '.join(str(error).split()) or type(error).__name__})"
        raise refusal(str(photo), wanted="a complete image", got=got, fix="remove the file") from None


def save_upright(picture: Image.Image, path: Path, max_side: int, *, exif: bytes = b"") -> None:
    """Saves a picture as JPEG, reduced to a longer side of `max_side` pixels if it is larger; 16-bit gray is scaled."""
    if picture.mode in DEPTH_MODES:
        picture = Image.fromarray((np.asarray(picture, np.uint32) // 257).clip(0, 255).astype(np.uint8))
    picture = picture.convert("RGB")
    picture.thumbnail((max_side, max_side), Image.Resampling.LANCZOS)
    picture.save(path, "JPEG", quality=JPEG_QUALITY, subsampling=0, exif=exif)


def _natural(path: Path) -> list[tuple[int, int, str]]:
    """Sort key that compares runs of digits as numbers."""
    parts = re.split(r"([0-9]+)", path.name)
    return [(0, int(part), "") if k % 2 else (1, 0, part) for k, part in enumerate(parts)]
