"""Reader of `cameras.json`, which 3D Gaussian splatting writes beside a scene: a list of cameras, and the images.

Each entry has `img_name` (with or without extension), `width`, `height`, `fx` and `fy` in pixels, `position` (camera
center) and `rotation` (camera-to-world, row by row, OpenCV axes). The principal point is the center of the image, or
`cx` and `cy` where other programs write them.
Images are in `images/` (or downscaled in `images_2`, `images_4`, `images_8`), else beside the file.
"""

from pathlib import Path

import numpy as np

from ssplat_jax.data.parsing import Fields, load_json
from ssplat_jax.data.posed_image import check_camtoworld
from ssplat_jax.data.readers.frame_list import (
    SUFFIXES,
    UNDISTORT,
    FrameList,
    Intrinsics,
    Listing,
    images_folder,
    stored_size,
)

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
    folder, entries = images_folder(root), load_json(file, list)
    frames = FrameList(root)
    for i, entry in enumerate(entries):
        fields = Fields(entry, f"{file}: [{i}]")
        name = fields.text("img_name")
        image = frames.named(folder + name, f"{fields.where}.img_name", ("", *SUFFIXES))
        matrix = np.column_stack([fields.numbers("rotation", (3, 3)), fields.numbers("position", (3,))])
        width, height = fields.number("width"), fields.number("height")
        cx, cy = fields.number("cx", width / 2), fields.number("cy", height / 2)
        intrinsics = Intrinsics(fx=fields.number("fx"), fy=fields.number("fy"), cx=cx, cy=cy)
        fields.refuse("k1", "k2", "k3", "p1", "p2", fix=UNDISTORT)
        sized = stored_size(image, (width, height), f"{fields.where}: width, height")
        frames.add(name, image, check_camtoworld(matrix, fields.where), intrinsics, sized, fields.where)
    return frames.listing(len(entries), "image")
