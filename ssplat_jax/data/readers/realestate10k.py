"""RealEstate10K: a text file of cameras and its video's frames as images named by their time, `<microseconds>.jpg`.

The first line is the video's address; then a line a frame: time, fx fy cx cy in units of the image's sides, two
numbers that are always 0, and the world-to-camera matrix, 3 x 4 row by row, OpenCV's axes.
Images lie in a folder of the text file's name beside it, in `images/`, or beside it. Lines without an image are left
out: videos disappear.
"""

from pathlib import Path

import numpy as np

from ssplat_jax.data.images import image_size
from ssplat_jax.data.posed_image import check_camtoworld, inverse
from ssplat_jax.data.readers import Listing
from ssplat_jax.data.readers.frame_list import EXTENSIONS, Intrinsics, find_file, make_frame, streamed
from ssplat_jax.data.readers.strict_text import load_lines, load_rows
from ssplat_jax.errors import echo, refusal

FORMAT = "RealEstate10K"
COLUMNS = 19


def matches(path: Path) -> bool:
    """Whether `path` is a file of cameras, or a folder with one and no other text file."""
    file = _cameras_file(path)
    if file is None:
        return False
    with file.open("rb") as opened:
        return opened.read(4) == b"http"


def read(path: Path) -> Listing:
    """The frames whose images are there."""
    file = _cameras_file(path)
    assert file is not None  # as `matches` said
    root = file.parent.resolve()
    lines = [(number, line) for number, line in load_lines(file)[1:] if line]
    rows = load_rows(file, COLUMNS, lines)
    frames, seen = [], set()
    for (number, _), row in zip(lines, rows, strict=True):
        where = f"{file}: line {number}"
        if not (np.isfinite(row[0]) and 0 <= row[0] < 2**53):
            raise refusal(where, wanted="a time in microseconds", got=echo(row[0]), fix="write the file anew")
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
                str(time), image, inverse(worldtocam), intrinsics, (width, height), where, pose_deviation=deviation
            )
        )
    if not frames:
        got = f"none of {len(lines)}"
        fix = f"put the frames into {file.stem}/, named by their time ({int(rows[0, 0]) if len(rows) else 0}.jpg)"
        raise refusal(str(file), wanted="images of its frames", got=got, fix=fix)
    num_missing = len(lines) - len(frames)
    missing = [f"{num_missing} of {len(lines)} frames are left out: no image is there."] if num_missing else []
    return streamed(file.stem, frames, missing)


def _cameras_file(path: Path) -> Path | None:
    if path.is_file():
        return path if path.suffix == ".txt" else None
    texts = sorted(path.glob("*.txt")) if path.is_dir() else []
    return texts[0] if len(texts) == 1 else None
