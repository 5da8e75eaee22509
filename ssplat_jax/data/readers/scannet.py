"""Reader of ScanNet exports: `color/0.jpg`, `pose/0.txt`, `intrinsic/intrinsic_color.txt`, optionally `depth/0.png`.

Poses are camera-to-world with OpenCV axes, in meters. Where tracking was lost they hold -inf, and the frame is skipped.
Depth maps hold millimeters and have their own resolution; they are taken to be registered to the color camera.
"""

from pathlib import Path

import numpy as np

from ssplat_jax.core.errors import refusal
from ssplat_jax.data.images import check_depth_header, image_size
from ssplat_jax.data.posed_image import check_camtoworld
from ssplat_jax.data.readers import Listing
from ssplat_jax.data.readers.frame_list import (
    Intrinsics,
    check_once,
    file_named,
    find_file,
    list_frames,
    make_frame,
)
from ssplat_jax.data.readers.strict_text import load_rows

FORMAT = "ScanNet"
IMAGES = (".jpg", ".jpeg", ".png")  # extensions of color images


def matches(path: Path) -> bool:
    """True if `path` is a folder with `color/` and `pose/`."""
    return (path / "color").is_dir() and (path / "pose").is_dir()


def read(path: Path) -> Listing:
    """Reads the tracked frames of the export in the folder `path`."""
    root = path.resolve()
    file = file_named(root, "intrinsic/intrinsic_color.txt", f"{path}: intrinsics")
    K = _matrix(file)
    intrinsics = Intrinsics(fx=K[0, 0], fy=K[1, 1], cx=K[0, 2], cy=K[1, 2])
    images = [image for image in sorted((root / "color").iterdir()) if image.suffix.lower() in IMAGES]
    frames, num_lost, seen = [], 0, dict[Path, str]()
    for image in images:
        check_once(seen, image.with_suffix(""), image.name, f"{image.parent}: {image.name}")
        pose_file = find_file(root, [f"pose/{image.stem}.txt"], str(image))
        matrix = None if pose_file is None else _matrix(pose_file)
        if matrix is None or not np.isfinite(matrix).all():
            num_lost += 1
            continue
        camtoworld, deviation = check_camtoworld(matrix, str(pose_file))
        where = f"{file} for {image.name}"
        depth = find_file(root, [f"depth/{image.stem}.png"], str(image))
        if depth is not None:
            check_depth_header(depth)
        size = image_size(image)
        name = f"color/{image.name}"
        frames.append(
            make_frame(name, image, camtoworld, intrinsics, size, where, pose_deviation=deviation, depth_path=depth)
        )
    if not frames:
        got = f"{len(images)} images, none of them with a finite pose"
        raise refusal(str(path), wanted="tracked frames", got=got, fix="export color/ and pose/ again")
    lost = [f"{num_lost} of {len(images)} frames are skipped: tracking was lost."] if num_lost else []
    return list_frames(root.name, frames, lost)


def _matrix(file: Path) -> np.ndarray:
    """Reads a 4x4 matrix."""
    rows = load_rows(file, 4)
    if rows.shape != (4, 4):
        raise refusal(str(file), wanted="four rows of four numbers", got=f"{len(rows)} rows", fix="export it again")
    return rows
