"""Reader of `cameras.json`, which 3D Gaussian splatting writes beside a scene: a list of cameras, and the images.

Each entry has `img_name` (with or without extension), `width`, `height`, `fx` and `fy` in pixels, `position` (camera
center) and `rotation` (camera-to-world, row by row, OpenCV axes). The principal point is the center of the image.
Images are in `images/` (or downscaled in `images_2`, `images_4`, `images_8`), else beside the file.
"""

from pathlib import Path

import numpy as np

from ssplat_jax.core.errors import refusal
from ssplat_jax.data.posed_image import check_camtoworld
from ssplat_jax.data.readers import Listing
from ssplat_jax.data.readers.frame_list import (
    EXTENSIONS,
    SHRUNK_FOLDERS,
    Intrinsics,
    check_once,
    file_named,
    list_frames,
    make_frame,
    stored_size,
)
from ssplat_jax.data.readers.strict_json import JsonFields, load_json_list

FORMAT = "cameras.json"


def matches(path: Path) -> bool:
    """True if `path` is a folder with a cameras.json that holds a list, or that file."""
    file = path if path.name == FORMAT else path / FORMAT
    if not file.is_file():
        return False
    with file.open("rb") as opened:
        return opened.read(64).lstrip().startswith(b"[")


def read(path: Path) -> Listing:
    """Reads the frames of the capture in the folder `path`, or of the file `path`."""
    file = path if path.is_file() else path / FORMAT
    root = file.parent.resolve()
    folder = "images/" if any((root / name).is_dir() for name in ("images", *SHRUNK_FOLDERS)) else ""
    frames, seen = [], {}
    for i, entry in enumerate(load_json_list(file)):
        fields = JsonFields(entry, f"{file}: [{i}]")
        name = fields.text("img_name")
        image = file_named(root, folder + name, f"{fields.where}.img_name", EXTENSIONS, SHRUNK_FOLDERS)
        check_once(seen, image, name, fields.where)
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = fields.numbers("rotation", (3, 3)), fields.numbers("position", (3,))
        pose, deviation = check_camtoworld(matrix, f"{fields.where}.rotation")
        described = (fields.number("width"), fields.number("height"))
        fix = "use the images that the scene was made from"
        size, shrink = stored_size(image, described, f"{fields.where}: width, height", fix)
        fx, fy = fields.number("fx"), fields.number("fy")
        intrinsics = Intrinsics(fx=fx, fy=fy, cx=described[0] / 2, cy=described[1] / 2)
        frames.append(
            make_frame(name, image, pose, intrinsics, size, fields.where, pose_deviation=deviation, shrink=shrink)
        )
    if not frames:
        raise refusal(str(file), wanted="cameras", got="an empty list", fix="write the file again")
    return list_frames(root.name, frames)
