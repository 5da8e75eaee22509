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
from ssplat_jax.data.parsing import load_lines, load_rows, parse_numbers, reading
from ssplat_jax.data.posed_image import check_camtoworld
from ssplat_jax.data.readers.frame_list import FrameList, Listing, images_in, pinhole, stored_size

FORMAT = "KITTI"
CAMERAS = (2, 3, 0, 1)  # in the order of search


def matches(path: Path) -> bool:
    """True if `path` is a sequence: a folder with `calib.txt` and a folder of images."""
    return (path / "calib.txt").is_file() and any((path / f"image_{camera}").is_dir() for camera in CAMERAS)


def read(path: Path) -> Listing:
    """Reads the images of the sequence in the folder `path` that have a pose."""
    root = path.resolve()
    camera = next(number for number in CAMERAS if (root / f"image_{number}").is_dir())
    calibration = f"{root / 'calib.txt'}: P{camera}"
    projection = _projection(root / "calib.txt", camera)
    intrinsics = pinhole(projection, calibration, 0.5)
    to_camera0 = np.eye(4)  # from this camera; both have the same axes
    with reading(calibration):
        to_camera0[:3, 3] = -np.linalg.solve(projection[:, :3], projection[:, 3])
    places = (root / "poses.txt", root.parent.parent / "poses" / f"{root.name}.txt")
    file = next((place for place in places if place.is_file()), None)
    if file is None:
        fix = f"download the odometry poses and copy poses/{root.name}.txt to {places[0]}"
        raise refusal(str(root), wanted=f"poses.txt, or ../../poses/{root.name}.txt", got="none", fix=fix)
    poses, images = load_rows(file, 12), images_in(root / f"image_{camera}")
    frames = FrameList(root)
    for image in images:
        if not (image.stem.isascii() and image.stem.isdigit() and len(image.stem) < 12):
            raise refusal(str(image), wanted="a number", got=echo(image.stem), fix="name images 000000.png and so on")
        number = int(image.stem)
        if number < len(poses):
            camera0, deviation = check_camtoworld(poses[number].reshape(3, 4), f"{file}: pose {number}")
            name, pose = f"image_{camera}/{image.name}", (camera0 @ to_camera0, deviation)
            frames.add(name, image, pose, intrinsics, stored_size(image, None, ""), calibration, key=number)
    return frames.listing(len(images), "pose")


def _projection(file: Path, camera: int) -> Float64[np.ndarray, "3 4"]:
    """Projection matrix of a camera."""
    for where, line in load_lines(file):
        name, _, text = line.partition(":")
        if name == f"P{camera}":
            matrix = np.reshape(parse_numbers(text.split(), where, 12), (3, 4))
            if np.isfinite(matrix).all():
                return matrix
            raise refusal(where, wanted="finite numbers", got="NaN or infinity", fix="copy the file again")
    raise refusal(str(file), wanted=f"a line P{camera}:", got="none", fix="copy the file again")
