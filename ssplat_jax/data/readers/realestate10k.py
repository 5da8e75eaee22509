"""Reader of RealEstate10K: a text file of cameras, and the frames of its video as images `<microseconds>.jpg`.

The first line is the address of the video. Each further line is a frame: time, fx fy cx cy in units of the image sides,
two zeros, and the 3x4 world-to-camera matrix row by row, with OpenCV axes. Images are in a folder named like the text
file, in `images/`, or beside the text file. Lines without an image are skipped, since videos disappear.
"""

from pathlib import Path

from ssplat_jax.core.errors import echo, refusal
from ssplat_jax.data.parsing import load_lines, load_rows
from ssplat_jax.data.posed_image import Convention, check_camtoworld
from ssplat_jax.data.readers.frame_list import SUFFIXES, FrameList, Intrinsics, Listing, find_file, stored_size

FORMAT = "RealEstate10K"
CONVENTION = Convention(poses="world-to-camera")
COLUMNS = 19  # numbers per line


def matches(path: Path) -> bool:
    """True if `path` is a file of cameras, or a folder that holds exactly one."""
    return len(_camera_files(path)) == 1


def read(path: Path) -> Listing:
    """Reads the frames whose images exist."""
    (file,) = _camera_files(path)
    root = file.parent.resolve()
    lines = [(where, line) for where, line in load_lines(file)[1:] if line]
    rows = load_rows(file, COLUMNS, lines)
    frames = FrameList(root, CONVENTION)
    for (where, _), row in zip(lines, rows, strict=True):
        if not 0 <= row[0] < 2**53:  # false for NaN too
            raise refusal(where, wanted="a time in microseconds", got=echo(row[0]), fix="write the file again")
        time = int(row[0])
        names = [f"{folder}/{time}{suffix}" for folder in (file.stem, "images", ".") for suffix in SUFFIXES]
        image = find_file(root, names, where)
        if image is not None:
            (width, height), _ = sized = stored_size(image, None, where)
            fx, fy, cx, cy = row[1:5] * (width, height, width, height)
            pose = check_camtoworld(row[7:].reshape(3, 4), where)
            frames.add(str(time), image, pose, Intrinsics(fx=fx, fy=fy, cx=cx, cy=cy), sized, where)
    example = f" ({int(rows[0, 0])}.jpg)" if len(rows) else ""
    return frames.listing(len(lines), f"image in {file.stem}/, named by its time{example},", name=file.stem)


def _camera_files(path: Path) -> list[Path]:
    """The file of cameras at `path`, or those in the folder `path`; other text files may lie beside them."""
    texts = [path] if path.is_file() else sorted(path.glob("*.txt")) if path.is_dir() else []
    return [file for file in texts if file.suffix == ".txt" and file.is_file() and _starts_with_address(file)]


def _starts_with_address(file: Path) -> bool:
    """True if the first line of a file may be the address of a video."""
    with file.open("rb") as opened:
        return opened.read(4) == b"http"
