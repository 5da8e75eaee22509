"""Reader of LLFF captures: `poses_bounds.npy` and the images, in the order of their names.

A row holds a 3x5 matrix row by row and two depths, which are not used. The first four columns are a camera-to-world
matrix whose camera axes are down, right and backward; the fifth is height, width and focal length in pixels of the full
image. The principal point is the center. Images are in `images/`, or downscaled in `images_2`, `images_4`, `images_8`.
"""

from pathlib import Path

import numpy as np

from ssplat_jax.core.errors import refusal
from ssplat_jax.data.parsing import reading
from ssplat_jax.data.posed_image import check_camtoworld
from ssplat_jax.data.readers.frame_list import (
    SHRUNK_FOLDERS,
    FrameList,
    Intrinsics,
    Listing,
    find_file,
    images_in,
    stored_size,
)

FORMAT = "LLFF"
FILE = "poses_bounds.npy"
COLUMNS = 17
FIX = "write it again with LLFF's imgs2poses.py"


def matches(path: Path) -> bool:
    """True if `path` is a folder with a poses_bounds.npy."""
    return (path / FILE).is_file()


def read(path: Path) -> Listing:
    """Reads the frames of the capture in the folder `path`."""
    root = path.resolve()
    with reading(path / FILE, FIX):
        rows = np.asarray(np.load(path / FILE, allow_pickle=False), np.float64)
    if rows.ndim != 2 or rows.shape[1] != COLUMNS or not len(rows):
        raise refusal(str(path / FILE), wanted=f"rows of {COLUMNS} numbers", got=f"shape {rows.shape}", fix=FIX)
    images = next((found for name in ("images", *SHRUNK_FOLDERS) if (found := images_in(root / name))), [])
    if len(images) != len(rows):
        fix = "use the images that LLFF used, all of them"
        wanted = f"{len(rows)} images, one for each row of {FILE}"
        raise refusal(str(path), wanted=wanted, got=str(len(images)), fix=fix)
    frames = FrameList(root)
    for i, (image, row) in enumerate(zip(images, rows, strict=True)):
        where, name = f"{path / FILE}: row {i}", str(image.relative_to(root))
        find_file(root, [name], str(image))  # refuses a link that leads outside
        down, right, backward, center, (height, width, focal) = row[:15].reshape(3, 5).T
        pose = check_camtoworld(np.stack([right, down, -backward, center], axis=1), where)
        intrinsics = Intrinsics(fx=focal, fy=focal, cx=width / 2, cy=height / 2)
        frames.add(name, image.resolve(), pose, intrinsics, stored_size(image, (width, height), where), where)
    return frames.listing(len(rows), "image")
