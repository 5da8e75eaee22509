"""The images that structure from motion reads: upright copies of photos, or frames chosen from a video.

video -> sharpness and motion of all frames -> sharp frames at equal distances of motion --+
folder -> photos in natural order -> upright copies of bounded size -----------------------+-> names of the images
"""

import re
import shutil
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, Int64
from PIL import Image, ImageOps
from PIL.ExifTags import IFD, Base
from scipy.ndimage import laplace

from ssplat_jax.core.errors import echo, optional_package, reading, refusal
from ssplat_jax.data.images import DEPTH_MODES, IMAGE_FORMATS, ORIENTATION, UPRIGHT
from ssplat_jax.data.open_capture import UNREADABLE_SUFFIXES
from ssplat_jax.data.readers.frame_list import LISTED, files_in, natural

Advance = Callable[[int], None]
JPEG_QUALITY = 95
KEPT_FORMATS = ("JPEG", "PNG")  # pycolmap reads no WebP, for one; other formats are converted
FOCAL_TAGS = (Base.FocalLength, Base.FocalLengthIn35mmFilm, Base.FocalPlaneXResolution, Base.FocalPlaneYResolution)
FOCAL_TAGS += (Base.FocalPlaneResolutionUnit, Base.ExifImageWidth, Base.ExifImageHeight)
"""EXIF tags from which COLMAP takes the focal length."""
SMALL_WIDTH = 192  # pixels of the longer side of the frames that are measured
STEP = 0.05  # of the width: motion between two chosen frames, if the number of frames allows
MIN_FRAMES = 20  # chosen even if the picture moves less than so many steps
BLOCK = 48  # pixels: side of the blocks that are followed
MIN_CONTRAST = 2.0  # gray levels (standard deviation) below which a block shows nothing to follow
KEY_SHIFT = 6.0  # pixels of motion after which the frame that motion is measured against is replaced
FIX = "check that it plays; convert it with `ffmpeg -i INPUT output.mp4`"


def list_photos(folder: Path) -> list[Path]:
    """The photos in a folder, or in its `images/`, in the order of names in which digits count as numbers.

    Raises:
        InputError: there are fewer than two, or one is of a kind that is not read and has no readable copy beside it.
    """
    for place in (folder, folder / "images"):
        files = sorted(files_in(place), key=lambda file: natural(file.name))
        photos = [file for file in files if file.suffix.lower() in LISTED]
        readable = {file.stem for file in photos}
        phone = [f for f in files if f.suffix.lower() in UNREADABLE_SUFFIXES and f.stem not in readable]
        if phone:
            got = f"{len(phone)} HEIC, AVIF or JPEG XL files" + (f" beside {len(photos)} others" if photos else "")
            fix = "convert them to JPEG first (the phone's camera settings call JPEG `most compatible`)"
            raise refusal(str(place), wanted="JPEG or PNG photos", got=got, fix=fix)
        if len(photos) > 1:
            return photos
    fix = f"give the folder that holds them ({', '.join(sorted(LISTED))}), or a video file"
    raise refusal(str(folder), wanted="a folder of photos", got="fewer than two images", fix=fix)


def copy_photos(photos: list[Path], folder: Path, max_side: int, advance: Advance) -> list[str]:
    """Copies photos into `folder`: as they are where they are upright and small JPEG or PNG files, otherwise as JPEG.

    Returns:
        The names of the copies. An underscore stands for each space, for a `#` at the start, which would begin a
        comment in COLMAP's lists, and for what is not UTF-8.

    Raises:
        InputError: a file is no readable image, or two names differ in these characters alone.
    """
    names: list[str] = []
    for photo in photos:
        name = re.sub(r"\s|^#|[\ud800-\udfff]", "_", photo.name)  # Python writes other bytes as surrogates
        with reading(photo, "remove the file"), warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # large photos are reduced
            picture = Image.open(photo, formats=IMAGE_FORMATS)
        with picture:
            orientation, exif = _exif_of(picture)
            is_small = max(picture.size) <= max_side
            is_kept = orientation == UPRIGHT and is_small and picture.format in KEPT_FORMATS
            name = name if is_kept else Path(name).stem + ".jpg"
            if name in names:
                got = f"{echo(name)} twice"
                raise refusal(str(photo), wanted="every name once", got=got, fix="rename one of the two")
            names.append(name)
            with reading(photo, "remove the file"):
                if not is_small:
                    picture.draft("RGB", (max_side, max_side))  # a JPEG is decoded at the least size that suffices
                picture.load()  # a damaged one is refused before hours of matching
            if is_kept:
                shutil.copyfile(photo, folder / name)
            else:
                picture.info.pop("exif", None)  # that may be damaged, and need not be written again
                upright = picture if orientation == UPRIGHT else ImageOps.exif_transpose(picture)
                _save_upright(upright, folder / name, max_side, exif)
        advance(len(names))
    return names


def _exif_of(picture: Image.Image) -> tuple[int, bytes]:
    """Orientation of a photo, and its EXIF data on the camera and the focal length, which COLMAP reads.

    The rest may be too long for a JPEG. Malformed data, as some cameras write them, count as none; an orientation that
    can be read is kept.
    """
    orientation = UPRIGHT
    try:
        exif = picture.getexif()
        if exif.get(ORIENTATION) in range(2, 9):
            orientation = exif[ORIENTATION]
        kept, inner = Image.Exif(), exif.get_ifd(IFD.Exif)
        kept.update({tag: exif[tag] for tag in (Base.Make, Base.Model) if tag in exif})
        kept[IFD.Exif] = {tag: inner[tag] for tag in FOCAL_TAGS if tag in inner}
        return orientation, kept.tobytes()
    except Exception:  # Pillow's parser raises nearly anything on damaged data
        return orientation, b""


def _save_upright(picture: Image.Image, path: Path, max_side: int, exif: bytes = b"") -> None:
    """Saves a picture as JPEG, reduced to a longer side of `max_side` pixels if it is larger; 16-bit gray is scaled."""
    if picture.mode in DEPTH_MODES:
        picture = Image.fromarray((np.asarray(picture, np.uint32) // 257).clip(0, 255).astype(np.uint8))
    picture = picture.convert("RGB")
    picture.thumbnail((max_side, max_side), Image.Resampling.LANCZOS)
    picture.save(path, "JPEG", quality=JPEG_QUALITY, subsampling=0, exif=exif)


def count_frames(path: Path) -> int:
    """Number of frames that the header of a video announces, or that its duration suggests; 0 if it tells neither."""
    with _open(path) as container:
        stream = container.streams.video[0]
        if stream.frames:
            return int(stream.frames)
        seconds = float(stream.duration * stream.time_base) if stream.duration else (container.duration or 0) / 1e6
        return int(seconds * float(stream.average_rate or 0))


def scan_video(path: Path, advance: Advance) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Motion since the first frame, in shares of the width, and sharpness of all frames of a video, as shown.

    Motion grows while the camera turns or moves, and stays while it stands still. Each frame is compared with a key
    frame, which is replaced when the picture has moved by `KEY_SHIFT` pixels. So slow motion is not lost in rounding,
    and noise of a still picture does not add up.

    Raises:
        InputError: the file is no readable video, or has fewer than two frames.
    """
    motion, sharpnesses, key, at_key = [], [], None, 0.0
    for frame in _frames(path):
        scale = min(SMALL_WIDTH / max(frame.width, frame.height), 1.0)
        width, height = (max(round(side * scale), 8) for side in (frame.width, frame.height))
        small = frame.reformat(width=width, height=height, format="gray", interpolation="AREA")
        gray = small.to_ndarray().astype(np.float32)
        shift = 0.0 if key is None else displacement(key, gray)
        motion.append(max(motion[-1] if motion else 0.0, at_key + shift / width))
        if key is None or shift >= KEY_SHIFT:
            key, at_key = gray, motion[-1]
        sharpnesses.append(float(np.mean(np.square(laplace(gray)[1:-1, 1:-1]))))  # comparable where frames are alike
        advance(len(motion))
    if len(motion) < 2:
        raise refusal(str(path), wanted="a video of a moving camera", got=f"{len(motion)} frames", fix=FIX)
    return np.array(motion), np.array(sharpnesses)


def displacement(before: Float32[np.ndarray, "h w"], after: Float32[np.ndarray, "h w"]) -> float:
    """Median displacement of the blocks of a gray image in [0, 255], in whole pixels, by phase correlation.

    Blocks without contrast are left out; without any block it is 0.
    """
    rows, columns = (side // BLOCK for side in before.shape)
    images = np.stack([before, after])[:, : rows * BLOCK, : columns * BLOCK]
    blocks = images.reshape(2, rows, BLOCK, columns, BLOCK).swapaxes(2, 3).reshape(2, -1, BLOCK, BLOCK)
    blocks = blocks[:, (blocks.std(axis=(2, 3)) > MIN_CONTRAST).all(axis=0)]
    if not blocks.shape[1]:
        return 0.0
    window = np.outer(np.hanning(BLOCK), np.hanning(BLOCK))
    spectra = np.fft.rfft2((blocks - blocks.mean(axis=(2, 3), keepdims=True)) * window)
    cross = spectra[1] * np.conj(spectra[0])
    peaks = np.fft.irfft2(cross / np.maximum(np.abs(cross), 1e-9), s=(BLOCK, BLOCK)).reshape(len(cross), -1).argmax(-1)
    shifts = np.stack(np.unravel_index(peaks, (BLOCK, BLOCK)), axis=-1)
    shifts = (shifts + BLOCK // 2) % BLOCK - BLOCK // 2
    return float(np.median(np.linalg.norm(shifts, axis=-1)))


def choose_frames(
    motion: Float64[np.ndarray, " n"], sharpnesses: Float64[np.ndarray, " n"], max_frames: int
) -> Int64[np.ndarray, " k"]:
    """The chosen frames of a video, in order.

    The motion of the video is divided into equal steps of at least `STEP`, at most `max_frames` of them. Around each
    step the sharpest frame is taken that is off by a quarter of a step at most, so two chosen frames are half a step to
    one and a half steps apart; where the picture jumps farther, the nearest frame is taken.
    """
    count = int(np.clip(motion[-1] / STEP + 1, MIN_FRAMES, max(max_frames, 2)))
    if count >= len(motion):
        return np.arange(len(motion))
    spacing = motion[-1] / (count - 1)
    if spacing == 0:  # nothing moves
        return np.array([int(np.argmax(sharpnesses))])
    chosen = set()
    for at in np.linspace(0, motion[-1], count):
        around = np.flatnonzero(np.abs(motion - at) <= spacing / 4)
        best = around[np.argmax(sharpnesses[around])] if len(around) else np.argmin(np.abs(motion - at))
        chosen.add(int(best))
    return np.array(sorted(chosen))


def write_frames(path: Path, chosen: Sequence[int], folder: Path, max_side: int, advance: Advance) -> list[str]:
    """Writes the frames `chosen` of a video as JPEG files, upright, named by their number; returns the names."""
    wanted, names = set(map(int, chosen)), []
    for number, frame in enumerate(_frames(path)):
        if number in wanted:
            names.append(f"{number:06d}.jpg")
            # A player turns the frames of a phone held upright counterclockwise by the degrees that the file asks for.
            picture = np.rot90(frame.to_ndarray(format="rgb24"), round(frame.rotation / 90) % 4)
            _save_upright(Image.fromarray(picture), folder / names[-1], max_side)
            advance(len(names))
            if len(names) == len(wanted):
                break
    return names


def _frames(path: Path) -> Iterator[Any]:
    """The frames of the first video stream, up to the first that is damaged."""
    av = optional_package("av", "poses")
    with _open(path) as container:
        container.streams.video[0].thread_type = "AUTO"
        try:
            yield from container.decode(container.streams.video[0])
        except av.FFmpegError:  # a recording that was cut off: what came before is of use
            return


def _open(path: Path) -> Any:
    """Container of a video file."""
    av = optional_package("av", "poses")
    try:
        container = av.open(str(path))
    except (av.FFmpegError, OSError) as error:
        got = f"a file that cannot be decoded ({getattr(error, 'strerror', None) or type(error).__name__})"
        raise refusal(str(path), wanted="a video", got=got, fix=FIX) from None
    if not container.streams.video:
        container.close()
        raise refusal(str(path), wanted="a video", got="a file without pictures", fix=FIX)
    return container
