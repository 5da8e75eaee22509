"""Reader of LLFF captures: `poses_bounds.npy` and the images, in the order of their names.

A row holds a 3x5 matrix row by row and two depths, which are not used. The first four columns are a camera-to-world
matrix whose camera axes are down, right and backward; the fifth is height, width and focal length in pixels of the full
image. The principal point is the center. Images are in `images/`, or downscaled in `images_2`, `images_4`, `images_8`.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float64

from ssplat_jax.core.errors import refusal
from ssplat_jax.data.posed_image import check_camtoworld
from ssplat_jax.data.readers import Listing
from ssplat_jax.data.readers.frame_list import (
    EXTENSIONS,
    SHRUNK_FOLDERS,
    Intrinsics,
    list_frames,
    make_frame,
    stored_size,
)

FORMAT = "LLFF"
FILE = "poses_bounds.npy"
COLUMNS = 17
MAX_BYTES = 64 << 20
FIX = "write it again with LLFF's imgs2poses.py"


def matches(path: Path) -> bool:
    """True if `path` is a folder with a poses_bounds.npy."""
    return (path / FILE).is_file()


def read(path: Path) -> Listing:
    """Reads the frames of the capture in the folder `path`."""
    root, rows = path.resolve(), _load_rows(path / FILE)
    images = _images(root)
    if len(images) != len(rows):
        got, fix = f"{len(images)}", "use the images that LLFF used, all of them"
        raise refusal(str(path), wanted=f"{len(rows)} images, one for each row of {FILE}", got=got, fix=fix)
    frames = []
    for i, (image, row) in enumerate(zip(images, rows, strict=True)):
        where = f"{path / FILE}: row {i}"
        matrix, (height, width, focal) = row[:15].reshape(3, 5)[:, :4], row[:15].reshape(3, 5)[:, 4]
        down, right, backward, center = matrix.T
        pose, deviation = check_camtoworld(np.stack([right, down, -backward, center], axis=1), where)
        size, shrink = stored_size(image, (width, height), where, "use the images that LLFF used")
        intrinsics = Intrinsics(fx=focal, fy=focal, cx=width / 2, cy=height / 2)
        name, file = str(image.relative_to(root)), image.resolve()
        frames.append(make_frame(name, file, pose, intrinsics, size, where, pose_deviation=deviation, shrink=shrink))
    return list_frames(root.name, frames)


def _load_rows(file: Path) -> Float64[np.ndarray, "n 17"]:
    """Table of poses and bounds."""
    size = file.stat().st_size
    if size > MAX_BYTES:
        raise refusal(str(file), wanted=f"at most {MAX_BYTES:,} bytes", got=f"{size:,}", fix=FIX)
    try:
        rows = np.load(file, allow_pickle=False)
        rows = np.asarray(rows, np.float64)
    except Exception as error:  # NumPy's parser raises nearly anything on damaged headers
        got = f"a file that NumPy cannot read ({type(error).__name__})"
        raise refusal(str(file), wanted="an array of numbers", got=got, fix=FIX) from None
    if rows.ndim != 2 or rows.shape[1] != COLUMNS or not len(rows):
        raise refusal(str(file), wanted=f"rows of {COLUMNS} numbers", got=f"shape {rows.shape}", fix=FIX)
    return rows


def _images(root: Path) -> list[Path]:
    """Images of the capture, in the order of names; those of the first folder that has any."""
    for folder in ("images", *SHRUNK_FOLDERS):
        found = sorted(file for file in (root / folder).glob("*") if file.suffix in EXTENSIONS[1:])
        if outside := next((file for file in found if not file.resolve().is_relative_to(root)), None):
            fix = "copy the images into the capture's folder"
            raise refusal(str(outside), wanted=f"an image inside {root}", got="a link that leads outside", fix=fix)
        if found:
            return found
    return []
