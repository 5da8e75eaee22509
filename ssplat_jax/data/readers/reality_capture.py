"""Reader of the CSV of cameras that RealityScan and RealityCapture export, and the images.

Of the export "Internal/External camera parameters", a row holds `#name, x, y, alt, heading, pitch, roll, f, px, py, k1,
k2, k3, k4, t1, t2`. Angles are in degrees: heading clockwise about the world's +z, then pitch, then roll, of a camera
that looks along -z with +y up (OpenGL). `f`, `px` and `py` are in millimeters of a sensor whose longer side is 36 mm;
the principal point is relative to the center. Images are in `images/`, else beside the file.
"""

import csv
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ssplat_jax.core.errors import refusal
from ssplat_jax.data.images import Lens
from ssplat_jax.data.parsing import AGAIN, load_text, parse_numbers, reading
from ssplat_jax.data.posed_image import Convention, check_camtoworld
from ssplat_jax.data.readers.frame_list import (
    SUFFIXES,
    UNDISTORT,
    FrameList,
    Intrinsics,
    Listing,
    file_named,
    files_with,
    images_folder,
    stored_size,
)

FORMAT = "RealityCapture"
CONVENTION = Convention(axes="opengl")
NEEDED = ("x", "y", "alt", "heading", "pitch", "roll", "f")
LENS = {"px": "px", "py": "py", "k1": "k1", "k2": "k2", "k3": "k3", "k4": "k4", "p1": "t1", "p2": "t2"}
UNKNOWN_LENS = ("k5", "k6", "skew")
SENSOR = 36.0  # millimeters of the longer side


def matches(path: Path) -> bool:
    """True if `path` is a CSV of cameras, or a folder that holds exactly one."""
    return len(_tables(path)) == 1


def read(path: Path) -> Listing:
    """Reads the cameras whose images exist."""
    (file,) = _tables(path)
    root = file.parent.resolve()
    text = load_text(file)
    with reading(file):
        rows = list(csv.DictReader(text.lstrip("#").splitlines(), skipinitialspace=True))
    frames, folder = FrameList(root, CONVENTION), images_folder(root)
    for i, row in enumerate(rows, start=2):
        where, name = f"{file}: line {i}", row.get("name") or ""
        if missing := [field for field in NEEDED if not row.get(field)]:
            raise refusal(where, wanted=", ".join(NEEDED), got=f"no {missing[0]}", fix=AGAIN)
        x, y, altitude, heading, pitch, roll, f = parse_numbers([row[field] for field in NEEDED], where)
        if odd := [field for field in UNKNOWN_LENS if float(row.get(field) or 0)]:
            raise refusal(where, wanted="a lens of k1 to k4, t1 and t2", got=odd[0], fix=UNDISTORT)
        lens = dict(zip(LENS, parse_numbers([row.get(field) or "0" for field in LENS.values()], where), strict=True))
        image = frames.find(folder + name, where, ("", *SUFFIXES))
        if image is None:
            continue
        (width, height), _ = sized = stored_size(image, None, where)
        unit = max(width, height) / SENSOR  # pixels per millimeter
        px, py = width / 2 + unit * lens.pop("px"), height / 2 + unit * lens.pop("py")
        matrix = np.eye(4)
        with reading(where):
            matrix[:3, :3] = Rotation.from_euler("ZXY", [-heading, pitch, roll], degrees=True).as_matrix()
        matrix[:3, 3] = x, y, altitude
        intrinsics = Intrinsics(fx=unit * f, fy=unit * f, cx=px, cy=py, lens=Lens(**lens))
        frames.add(name, image, check_camtoworld(matrix, where), intrinsics, sized, where)
    if rows and not frames.frames:
        file_named(root, folder + (rows[0].get("name") or "image"), f"{file}: line 2")  # refuses it
    return frames.listing(len(rows), "image")


def _tables(path: Path) -> list[Path]:
    """The file at `path`, or those in the folder `path`, that begin with the names of a camera's columns."""
    return files_with(path, ".csv", b"name", b"heading", b"pitch", b"roll")
