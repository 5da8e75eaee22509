"""Readers of data sets: ScanNet, TUM RGB-D, KITTI, RealEstate10K, LLFF."""

import math
import re
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from ssplat_jax.core.errors import AGAIN, echo, reading, refusal
from ssplat_jax.data.images import Lens, image_size
from ssplat_jax.data.parsing import load_lines, load_rows, load_text, parse_numbers
from ssplat_jax.data.posed_image import Convention, pose_from_quat
from ssplat_jax.data.readers.frame_list import (
    SHRUNK_FOLDERS,
    SUFFIXES,
    FrameList,
    Intrinsics,
    Listing,
    Reader,
    files_in,
    files_with,
    find_file,
    find_image,
    images_in,
    name_in,
    pinhole,
)

# -- ScanNet ----------------------------------------------------------------------------------------------------------
# Exports: `color/0.jpg`, `pose/0.txt`, `intrinsic/intrinsic_color.txt`, optionally `depth/0.png`. Poses are
# camera-to-world with OpenCV axes, in meters. Where tracking was lost they hold -inf, and the frame is skipped. Depth
# maps hold millimeters and have their own resolution; they are taken to be registered to the color camera.


def _read_scannet(path: Path, convention: Convention) -> Listing:
    """The tracked frames."""
    frames = FrameList(path, convention)
    file = frames.file_named("intrinsic/intrinsic_color.txt", f"{path}: intrinsics")
    intrinsics, images = pinhole(load_rows(file, 4), str(file)), images_in(frames.root / "color")
    for image in images:
        pose_file = find_file(frames.root, [f"pose/{image.stem}.txt"], str(image))
        if pose_file is not None and np.isfinite(matrix := load_rows(pose_file, 4)).all():
            depth = find_file(frames.root, [f"depth/{image.stem}.png"], str(image))
            name, where = f"color/{image.name}", f"{pose_file}, {file}"
            frames.add(name, image, matrix, intrinsics, where, key=image.stem, depth=depth)
    return frames.listing(len(images), "finite pose")


SCANNET = Reader("ScanNet", lambda path: (path / "color").is_dir() and (path / "pose").is_dir(), _read_scannet)

# -- TUM RGB-D --------------------------------------------------------------------------------------------------------
# `rgb.txt` and `depth.txt` list times and files, `groundtruth.txt` camera-to-world poses (time, tx ty tz, qx qy qz qw).
# The pose of an image is interpolated between its neighbors in time; images between poses more than `MAX_POSE_GAP`
# apart are skipped, as are listed files that do not exist; an image that is listed at several times counts once, at the
# first. Depth maps are in units of 1/5000 m, or of what a `DepthMapFactor` in a .yaml file (ORB-SLAM) or a
# `png_depth_scale` or `scale` in a .json file (Replica) beside them says; an image gets the nearest one within
# `MAX_DEPTH_GAP`. Intrinsics are read from `calibration.txt` (fx fy cx cy, optionally k1 k2 p1 p2 k3). Without it,
# `freiburg1` to `freiburg3` in the name of the folder selects those of the color camera from
# cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats. Both have the center of the first pixel at 0, so half a pixel
# is added.

MAX_POSE_GAP = 0.1  # seconds between the two poses around an image
MAX_DEPTH_GAP = 0.02  # seconds between an image and its depth map
DEPTH_FACTOR = 5000.0  # steps of a depth map in a meter
FACTOR = re.compile(r"\b(?:DepthMapFactor|png_depth_scale|depth_scale|scale)\"?\s*[:=]\s*([0-9.eE+-]+)")
SIZE = (640.0, 480.0)  # (width, height) of the images that the calibrations below are for
CALIBRATIONS = {  # fx fy cx cy k1 k2 p1 p2 k3
    "freiburg1": (517.3, 516.5, 318.6, 255.3, 0.2624, -0.9531, -0.0054, 0.0026, 1.1633),
    "freiburg2": (520.9, 521.0, 325.1, 249.7, 0.2312, -0.7849, -0.0033, -0.0001, 0.9172),
    "freiburg3": (535.4, 539.2, 320.1, 247.6),
}


def _read_tum(path: Path, convention: Convention) -> Listing:
    """The images whose poses are known."""
    frames = FrameList(path, convention)
    root, named = frames.root, re.search("freiburg[123]", frames.root.name)
    intrinsics, calibration = _calibration(root / "calibration.txt", named[0] if named else None)
    described = SIZE if calibration in CALIBRATIONS else None
    poses = load_rows(root / "groundtruth.txt", 8)
    poses = poses[np.isfinite(poses).all(axis=1)]  # others say that tracking was lost
    poses = poses[np.argsort(poses[:, 0], kind="stable")]
    listed, notes = _listed_files(frames, "rgb.txt")
    depths, depth_notes = _listed_files(frames, "depth.txt") if (root / "depth.txt").is_file() else ([], [])
    images = {file: time for time, file in reversed(listed)}  # each at its first time
    if len(images) < len(listed):
        again = len(listed) - len(images)
        notes = [f"{again} lines of rgb.txt list an image again; its first time counts.", *notes]
    factor = _depth_factor(root)
    if depths and factor is None and not named:
        depth_notes = [*depth_notes, "Depth maps are taken to be in steps of 1/5000 m, as TUM's are: no file says so."]
    unit = 1 / (factor or DEPTH_FACTOR)
    for image, time in sorted(images.items(), key=lambda item: item[::-1]):
        pose = pose_at(time, poses, f"{root / 'groundtruth.txt'} at {time:.6f}")
        if pose is not None:
            given = {"depth": _depth_at(time, depths), "depth_unit": unit}
            frames.add(name_in(root, image), image, pose, intrinsics, calibration, described, **given)
    return frames.listing(len(images), "pose at their time", [*notes, *depth_notes], is_in_time=True)


def _depth_factor(root: Path) -> float | None:
    """Steps of a depth map in a meter, as a file beside the images says; None if there is none."""
    for file in [file for suffix in ("yaml", "yml", "json") for file in files_in(root, f"*.{suffix}")]:
        if found := FACTOR.search(load_text(file)):
            (factor,) = parse_numbers([found[1]], str(file), 1)
            if not 0 < factor < math.inf:
                raise refusal(str(file), wanted="a depth factor above 0", got=echo(found[1]), fix="mend the file")
            return factor
    return None


def _listed_files(frames: FrameList, name: str) -> tuple[list[tuple[float, Path]], list[str]]:
    """(time, file) of a list of files, in the order of time, and a note about listed files that do not exist."""
    found, missing = [], []
    for where, line in load_lines(frames.root / name):
        if line:
            time, *file_name = line.split(maxsplit=1)
            if not file_name:
                raise refusal(where, wanted="a time and a file", got=echo(line), fix=AGAIN)
            file = find_image(frames.root, file_name[0], where)
            found.append((parse_numbers([time], where)[0], file))
            missing += [(file_name[0], where)] if file is None else []
    if missing and len(missing) == len(found) and name == "rgb.txt":
        frames.file_named(*missing[0])  # refuses it
    notes = [f"{len(missing)} files of {name} are missing and left out."] if missing else []
    return sorted((time, file) for time, file in found if file is not None), notes


def pose_at(time: float, poses: Float64[np.ndarray, "n 8"], where: str) -> tuple[np.ndarray, np.ndarray] | None:
    """The camera's quaternion (wxyz) and center at a time, between the rows (time, tx ty tz, qx qy qz qw) around it.

    None if these are more than `MAX_POSE_GAP` apart. The nearest of 100 poses per second would be up to 5 ms off.
    """
    before, after = (int(np.searchsorted(poses[:, 0], time, side)) for side in ("right", "left"))
    before -= 1  # a pose at exactly this time is both
    if before < 0 or after >= len(poses) or poses[after, 0] - poses[before, 0] > MAX_POSE_GAP:
        return None
    a, b = poses[before], poses[after]
    share = (time - a[0]) / (b[0] - a[0]) if b[0] > a[0] else 0.0
    for pose in (a, b):
        pose_from_quat(pose[[7, 4, 5, 6]], pose[1:4], where)  # refuses what is no pose, before it is mixed
    quat_a, quat_b = (pose[[7, 4, 5, 6]] / math.hypot(*pose[4:]) for pose in (a, b))  # wxyz
    # Linear interpolation: within a tenth of a second it differs from the arc by some millionths.
    quat = (1 - share) * quat_a + share * np.copysign(1.0, quat_a @ quat_b) * quat_b
    return quat, (1 - share) * a[1:4] + share * b[1:4]


def _depth_at(time: float, depths: list[tuple[float, Path]]) -> Path | None:
    """Depth map nearest in time, or None if none is within `MAX_DEPTH_GAP`."""
    places = range(*np.searchsorted([at for at, _ in depths], [time - MAX_DEPTH_GAP, time + MAX_DEPTH_GAP]))
    return min((depths[i] for i in places), key=lambda depth: abs(depth[0] - time), default=(0.0, None))[1]


def _calibration(file: Path, named: str | None) -> tuple[Intrinsics, str]:
    """Intrinsics of the color camera, of a file or by name, and their location for messages."""
    if file.is_file():
        where, values = str(file), parse_numbers(load_text(file).split(), str(file))
        if not 4 <= len(values) <= 9:
            got = f"{len(values)} numbers"
            raise refusal(where, wanted="fx fy cx cy [k1 k2 p1 p2 k3]", got=got, fix="write these numbers")
    elif named:
        where, values = named, CALIBRATIONS[named]
    else:
        got, fix = "neither it nor freiburg1, 2 or 3 in the folder's name", "write fx fy cx cy into the file"
        raise refusal(str(file), wanted="a calibration", got=got, fix=fix)
    fx, fy, cx, cy, *distortion = values
    lens = Lens(**dict(zip(("k1", "k2", "p1", "p2", "k3"), distortion, strict=False)))
    return Intrinsics(fx=fx, fy=fy, cx=cx + 0.5, cy=cy + 0.5, lens=lens), where


TUM = Reader("TUM RGB-D", lambda path: all((path / f"{x}.txt").is_file() for x in ("rgb", "groundtruth")), _read_tum)

# -- KITTI ------------------------------------------------------------------------------------------------------------
# Odometry sequences: `sequences/00/` with `calib.txt` and `image_2/000000.png`, and `poses/00.txt`. The latter, beside
# `sequences/`, may also lie in the sequence as `poses.txt`. Line i is the 3x4 camera-to-world matrix of camera 0 at
# image i, with OpenCV axes, in meters. `calib.txt` has a projection matrix P0 to P3 of each rectified camera, whose
# fourth column is its offset from camera 0. The first of image_2, image_3 (color), image_0 and image_1 that exists is
# read. Pixel centers of the calibration are at whole numbers, so half a pixel is added.

KITTI_CAMERAS = (2, 3, 0, 1)  # in the order of search


def _is_kitti(path: Path) -> bool:
    return (path / "calib.txt").is_file() and any((path / f"image_{camera}").is_dir() for camera in KITTI_CAMERAS)


def _read_kitti(path: Path, convention: Convention) -> Listing:
    """The images that have a pose."""
    frames = FrameList(path, convention)
    root = frames.root
    camera = next(number for number in KITTI_CAMERAS if (root / f"image_{number}").is_dir())
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
    for image in images:
        if not (image.stem.isascii() and image.stem.isdigit() and len(image.stem) < 12):
            raise refusal(str(image), wanted="a number", got=echo(image.stem), fix="name images 000000.png and so on")
        if (i := int(image.stem)) < len(poses):
            with np.errstate(over="ignore", invalid="ignore"):  # the list refuses what is not finite
                pose = poses[i].reshape(3, 4) @ to_camera0
            where = f"{file}: pose {i}, {calibration}"
            frames.add(f"image_{camera}/{image.name}", image, pose, intrinsics, where, key=i)
    return frames.listing(len(images), "pose")


def _projection(file: Path, camera: int) -> Float64[np.ndarray, "3 4"]:
    """Projection matrix of a camera."""
    for where, line in load_lines(file):
        name, _, text = line.partition(":")
        if name == f"P{camera}":
            return np.reshape(parse_numbers(text.split(), where, 12), (3, 4))
    raise refusal(str(file), wanted=f"a line P{camera}:", got="none", fix="copy the file again")


KITTI = Reader("KITTI", _is_kitti, _read_kitti)

# -- RealEstate10K ----------------------------------------------------------------------------------------------------
# A text file of cameras, and the frames of its video as images `<microseconds>.jpg`. The first line is the address of
# the video. Each further line is a frame: time, fx fy cx cy in units of the image sides, two zeros, and the 3x4
# world-to-camera matrix row by row, with OpenCV axes. Images are in a folder named like the text file, in `images/`, or
# beside the text file. Lines without an image are skipped, since videos disappear.

NUM_COLUMNS = 19  # per line
TEXT = (".txt", rb"\Ahttp")  # suffix and start of a file of cameras; other text files may lie beside it


def _read_realestate10k(path: Path, convention: Convention) -> Listing:
    """The frames whose images exist."""
    (file,) = files_with(path, *TEXT)
    frames, lines = FrameList(file.parent, convention), [(w, line) for w, line in load_lines(file)[1:] if line]
    rows = load_rows(file, NUM_COLUMNS, lines)
    for (where, _), row in zip(lines, rows, strict=True):
        if not 0 <= row[0] < 2**53:  # false for NaN too
            raise refusal(where, wanted="a time in microseconds", got=echo(row[0]), fix=AGAIN)
        time = int(row[0])
        names = [f"{folder}/{time}{suffix}" for folder in (file.stem, "images", ".") for suffix in SUFFIXES]
        if (image := find_file(frames.root, names, where)) is not None:
            width, height = image_size(image)
            intrinsics = Intrinsics(*(row[1:5] * (width, height, width, height)).tolist())
            frames.add(str(time), image, row[7:].reshape(3, 4), intrinsics, where)
    example = f" ({int(rows[0, 0])}.jpg)" if len(rows) else ""
    return frames.listing(len(lines), f"image in {file.stem}/, named by its time{example},", name=file.stem)


TO_CAMERA = Convention(poses="world-to-camera")
REALESTATE10K = Reader("RealEstate10K", lambda path: len(files_with(path, *TEXT)) == 1, _read_realestate10k, TO_CAMERA)

# -- LLFF -------------------------------------------------------------------------------------------------------------
# `poses_bounds.npy` and the images, in the order of their names. A row holds a 3x5 matrix row by row and two depths,
# which are not used. The first four columns are a camera-to-world matrix whose camera axes are down, right and
# backward; the fifth is height, width and focal length in pixels of the full image. The principal point is the center.
# Images are in `images/`, or downscaled in `images_2`, `images_4`, `images_8`.

POSES_BOUNDS = "poses_bounds.npy"
IMGS2POSES = "write it again with LLFF's imgs2poses.py"


def _read_llff(path: Path, convention: Convention) -> Listing:
    frames, file = FrameList(path, convention), path / POSES_BOUNDS
    with reading(file, IMGS2POSES):
        rows = np.asarray(np.load(file, allow_pickle=False), np.float64)
    if rows.ndim != 2 or rows.shape[1] != 17 or not len(rows):
        raise refusal(str(file), wanted="rows of 17 numbers", got=f"shape {rows.shape}", fix=IMGS2POSES)
    images = next((found for name in ("images", *SHRUNK_FOLDERS) if (found := images_in(frames.root / name))), [])
    if len(images) != len(rows):
        wanted, fix = f"{len(rows)} images, one for each row of {file.name}", "use all the images that LLFF used"
        raise refusal(str(path), wanted=wanted, got=str(len(images)), fix=fix)
    for i, (image, row) in enumerate(zip(images, rows, strict=True)):
        down, right, backward, center, (height, width, focal) = row[:15].reshape(3, 5).T
        pose = np.stack([right, down, -backward, center], axis=1)
        intrinsics = Intrinsics(fx=focal, fy=focal, cx=width / 2, cy=height / 2)
        name, where = str(image.relative_to(frames.root)), f"{file}: row {i}"
        frames.add(name, image, pose, intrinsics, where, (width, height))
    return frames.listing(len(rows), "image")


LLFF = Reader("LLFF", lambda path: (path / POSES_BOUNDS).is_file(), _read_llff)
