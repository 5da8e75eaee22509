"""Reader of RealEstate10K: a text file of cameras, and the frames of its video as images `<microseconds>.jpg`.

The first line is the address of the video. Each further line is a frame: time, fx fy cx cy in units of the image sides,
two zeros, and the 3x4 world-to-camera matrix row by row, with OpenCV axes. Images are in a folder named like the text
file, in `images/`, or beside the text file. Lines without an image are skipped, since videos disappear.
"""

from pathlib import Path

import numpy as np

from ssplat_jax.core.errors import echo, refusal
from ssplat_jax.data.images import image_size
from ssplat_jax.data.pose_conventions import Convention
from ssplat_jax.data.posed_image import check_camtoworld
from ssplat_jax.data.readers import Listing
from ssplat_jax.data.readers.frame_list import EXTENSIONS, Intrinsics, find_file, list_frames, make_frame
from ssplat_jax.data.readers.strict_text import load_lines, load_rows

FORMAT = "RealEstate10K"
CONVENTION = Convention(poses="world-to-camera")
COLUMNS = 19  # numbers per line


def matches(path: Path) -> bool:
    """True if `path` is a file of cameras, or a folder that holds exactly one."""
    return _cameras_file(path) is not None


def read(path: Path) -> Listing:
    """Reads the frames whose images exist."""
    file = _cameras_file(path)
    assert file is not None  # `matches` is true
    root = file.parent.resolve()
    lines = [(number, line) for number, line in load_lines(file)[1:] if line]
    rows = load_rows(file, COLUMNS, lines)
    frames, seen = [], set()
    for (number, _), row in zip(lines, rows, strict=True):
        where = f"{file}: line {number}"
        if not (np.isfinite(row[0]) and 0 <= row[0] < 2**53):
            raise refusal(where, wanted="a time in microseconds", got=echo(row[0]), fix="write the file again")
        time = int(row[0])
        if time in seen:
            raise refusal(where, wanted="every time once", got=f"{time} twice", fix="remove one of the two lines")
        seen.add(time)
        names = [f"{folder}/{time}{e}" for folder in (file.stem, "images", ".") for e in EXTENSIONS[1:]]
        image = find_file(root, names, where)
        if image is None:
            continue
        worldtocam, deviation = check_camtoworld(row[7:].reshape(3, 4), where)
        width, height = image_size(image)
        intrinsics = Intrinsics(fx=row[1] * width, fy=row[2] * height, cx=row[3] * width, cy=row[4] * height)
        frames.append(
            make_frame(
                str(time),
                image,
                CONVENTION.to_opencv(worldtocam),
                intrinsics,
                (width, height),
                where,
                pose_deviation=deviation,
            )
        )
    if not frames:
        got = f"none of {len(lines)}"
        fix = f"place the frames in {file.stem}/, named by their time ({int(rows[0, 0]) if len(rows) else 0}.jpg)"
        raise refusal(str(file), wanted="images of its frames", got=got, fix=fix)
    num_missing = len(lines) - len(frames)
    missing = [f"{num_missing} of {len(lines)} frames are skipped: their images are missing."] if num_missing else []
    return list_frames(file.stem, frames, missing)


def _cameras_file(path: Path) -> Path | None:
    """The file of cameras at `path`, or the only one in the folder `path`; other text files may lie beside it."""
    if path.is_file():
        return path if path.suffix == ".txt" and _starts_with_address(path) else None
    texts = [file for file in sorted(path.glob("*.txt")) if _starts_with_address(file)] if path.is_dir() else []
    return texts[0] if len(texts) == 1 else None


def _starts_with_address(file: Path) -> bool:
    """True if the first line of a file may be the address of a video."""
    if not file.is_file():
        return False
    with file.open("rb") as opened:
        return opened.read(4) == b"http"
