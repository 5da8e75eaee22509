"""Reader of ScanNet exports: `color/0.jpg`, `pose/0.txt`, `intrinsic/intrinsic_color.txt`, optionally `depth/0.png`.

Poses are camera-to-world with OpenCV axes, in meters. Where tracking was lost they hold -inf, and the frame is skipped.
Depth maps hold millimeters and have their own resolution; they are taken to be registered to the color camera.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float64

from ssplat_jax.core.errors import refusal
from ssplat_jax.data.parsing import load_rows
from ssplat_jax.data.posed_image import check_camtoworld
from ssplat_jax.data.readers.frame_list import (
    FrameList,
    Listing,
    file_named,
    find_file,
    images_in,
    pinhole,
    stored_size,
)

FORMAT = "ScanNet"


def matches(path: Path) -> bool:
    """True if `path` is a folder with `color/` and `pose/`."""
    return (path / "color").is_dir() and (path / "pose").is_dir()


def read(path: Path) -> Listing:
    """Reads the tracked frames of the export in the folder `path`."""
    root = path.resolve()
    file = file_named(root, "intrinsic/intrinsic_color.txt", f"{path}: intrinsics")
    intrinsics = pinhole(_matrix(file), str(file))
    frames, images = FrameList(root), images_in(root / "color")
    for image in images:
        pose_file = find_file(root, [f"pose/{image.stem}.txt"], str(image))
        matrix = np.full((4, 4), np.nan) if pose_file is None else _matrix(pose_file)
        if np.isfinite(matrix).all():
            pose, sized = check_camtoworld(matrix, str(pose_file)), stored_size(image, None, "")
            depth = find_file(root, [f"depth/{image.stem}.png"], str(image))
            name, where = f"color/{image.name}", f"{file} for {image.name}"
            frames.add(name, image, pose, intrinsics, sized, where, key=image.stem, depth=depth)
    return frames.listing(len(images), "finite pose")


def _matrix(file: Path) -> Float64[np.ndarray, "4 4"]:
    """Reads a 4x4 matrix."""
    rows = load_rows(file, 4)
    if rows.shape != (4, 4):
        raise refusal(str(file), wanted="four rows of four numbers", got=f"{len(rows)} rows", fix="export it again")
    return rows
