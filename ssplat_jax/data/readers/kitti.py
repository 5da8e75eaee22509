"""Reader of KITTI's odometry sequences: `sequences/00/` with `calib.txt` and `image_2/000000.png`, and `poses/00.txt`.

`poses/00.txt`, beside `sequences/`, may also lie in the sequence as `poses.txt`. Line i is the 3x4 camera-to-world
matrix of camera 0 at image i, with OpenCV axes, in meters. `calib.txt` has a projection matrix P0 to P3 of each
rectified camera, whose fourth column is its offset from camera 0. The first of image_2, image_3 (color), image_0 and
image_1 that exists is read. Pixel centers of the calibration are at whole numbers, so half a pixel is added.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float64

from ssplat_jax.core.errors import echo, refusal
from ssplat_jax.data.images import image_size
from ssplat_jax.data.posed_image import check_camtoworld
from ssplat_jax.data.readers import Listing
from ssplat_jax.data.readers.frame_list import Intrinsics, check_once, list_frames, make_frame
from ssplat_jax.data.readers.strict_text import load_lines, load_rows, parse_numbers

FORMAT = "KITTI"
CAMERAS = (2, 3, 0, 1)  # in the order of search
IMAGES = frozenset({".png", ".jpg"})


def matches(path: Path) -> bool:
    """True if `path` is a sequence: a folder with `calib.txt` and a folder of images."""
    return (path / "calib.txt").is_file() and _camera(path) is not None


def read(path: Path) -> Listing:
    """Reads the images of the sequence in the folder `path` that have a pose."""
    root, camera = path.resolve(), _camera(path)
    assert camera is not None  # `matches` is true
    projection = _projection(root / "calib.txt", camera)
    intrinsics = Intrinsics(
        fx=projection[0, 0], fy=projection[1, 1], cx=projection[0, 2] + 0.5, cy=projection[1, 2] + 0.5
    )
    to_camera0 = np.eye(4)  # from this camera; both have the same axes
    to_camera0[:3, 3] = -np.linalg.solve(projection[:, :3], projection[:, 3])
    file = _poses_file(root)
    poses = load_rows(file, 12)
    images = [image for image in sorted((root / f"image_{camera}").iterdir()) if image.suffix.lower() in IMAGES]
    frames, seen = [], dict[Path, str]()
    for image in images:
        if not (image.stem.isascii() and image.stem.isdigit() and len(image.stem) < 12):
            fix = "name images by their number, 000000.png"
            raise refusal(str(image), wanted="a number", got=echo(image.stem), fix=fix)
        number = int(image.stem)
        check_once(seen, image.with_name(str(number)), image.name, f"{image.parent}: {image.name}")
        if number >= len(poses):
            continue
        where = f"{file}: pose {number}"
        camera0, deviation = check_camtoworld(poses[number].reshape(3, 4), where)
        size, calibration = image_size(image), f"{root / 'calib.txt'}: P{camera}"
        name = f"image_{camera}/{image.name}"
        frames.append(
            make_frame(name, image, camera0 @ to_camera0, intrinsics, size, calibration, pose_deviation=deviation)
        )
    if not frames:
        got, fix = f"{len(images)} images and {len(poses)} poses", "use the poses of this sequence"
        raise refusal(str(path), wanted="images with poses", got=got, fix=fix)
    num_lost = len(images) - len(frames)
    lost = [f"{num_lost} of {len(images)} images are skipped: they have no pose."] if num_lost else []
    return list_frames(root.name, frames, lost)


def _camera(path: Path) -> int | None:
    """Number of the camera whose images are read, or None."""
    return next((number for number in CAMERAS if (path / f"image_{number}").is_dir()), None)


def _poses_file(root: Path) -> Path:
    """File of the poses of the sequence in the folder `root`."""
    for file in (root / "poses.txt", root.parent.parent / "poses" / f"{root.name}.txt"):
        if file.is_file():
            return file
    got, fix = "none", f"download the odometry poses and copy poses/{root.name}.txt to {root}/poses.txt"
    raise refusal(str(root), wanted=f"poses.txt, or ../../poses/{root.name}.txt", got=got, fix=fix)


def _projection(file: Path, camera: int) -> Float64[np.ndarray, "3 4"]:
    """Projection matrix of a camera."""
    for number, line in load_lines(file):
        name, _, text = line.partition(":")
        if name != f"P{camera}":
            continue
        where, values = f"{file}: line {number}", parse_numbers(text.split(), f"{file}: line {number}")
        matrix = np.reshape(values, (3, 4)) if len(values) == 12 else None
        if matrix is None:
            raise refusal(where, wanted="12 numbers", got=str(len(values)), fix="copy the file again")
        if not np.isfinite(matrix).all() or abs(np.linalg.det(matrix[:, :3])) < 1e-12:
            raise refusal(where, wanted="a camera matrix", got=echo(values), fix="copy the file again")
        return matrix
    raise refusal(str(file), wanted=f"a line P{camera}:", got="none", fix="copy the file again")
