"""Reader of TUM RGB-D sequences.

`rgb.txt` and `depth.txt` list times and files, `groundtruth.txt` camera-to-world poses (time, tx ty tz, qx qy qz qw).
The pose of an image is interpolated between its neighbors in time; images between poses more than `MAX_POSE_GAP` apart
are skipped, as are listed files that do not exist; an image that is listed at several times counts once, at the first.
Depth maps are in units of 1/5000 m; an image gets the nearest one within `MAX_DEPTH_GAP`.
Intrinsics are read from `calibration.txt` (fx fy cx cy, optionally k1 k2 p1 p2 k3). Without it, `freiburg1` to
`freiburg3` in the name of the folder selects those of the color camera from
cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats. Both have the center of the first pixel at 0, so half a pixel is
added.
"""

import math
import re
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from ssplat_jax.core.errors import echo, refusal
from ssplat_jax.data.images import check_depth_header, image_size
from ssplat_jax.data.lens import Lens
from ssplat_jax.data.posed_image import pose_from_quat
from ssplat_jax.data.readers import Listing
from ssplat_jax.data.readers.frame_list import Intrinsics, file_named, find_named, list_frames, make_frame
from ssplat_jax.data.readers.strict_text import load_lines, load_rows, parse_numbers

FORMAT = "TUM RGB-D"
MAX_POSE_GAP = 0.1  # seconds between the two poses around an image
MAX_DEPTH_GAP = 0.02  # seconds between an image and its depth map
DEPTH_UNIT = 1 / 5000  # meters
CALIBRATIONS = {  # fx fy cx cy k1 k2 p1 p2 k3
    "freiburg1": (517.3, 516.5, 318.6, 255.3, 0.2624, -0.9531, -0.0054, 0.0026, 1.1633),
    "freiburg2": (520.9, 521.0, 325.1, 249.7, 0.2312, -0.7849, -0.0033, -0.0001, 0.9172),
    "freiburg3": (535.4, 539.2, 320.1, 247.6),
}


def matches(path: Path) -> bool:
    """True if `path` is a folder with `rgb.txt` and `groundtruth.txt`."""
    return (path / "rgb.txt").is_file() and (path / "groundtruth.txt").is_file()


def read(path: Path) -> Listing:
    """Reads the images of the sequence in the folder `path` whose poses are known."""
    root = path.resolve()
    intrinsics, calibration = _intrinsics(root)
    poses = load_rows(root / "groundtruth.txt", 8)
    poses = poses[np.argsort(poses[:, 0], kind="stable")]
    listed, num_gone = _files(root, "rgb.txt", needed=True)
    images, num_again = _each_once(listed)
    depths, depths_gone = _files(root, "depth.txt") if (root / "depth.txt").is_file() else ([], 0)
    frames = []
    for time, image in images:
        where = f"{root / 'groundtruth.txt'} at {time:.6f}"
        pose = _pose_at(time, poses, where)
        if pose is None:
            continue
        depth = _depth_at(time, depths)
        if depth is not None:
            check_depth_header(depth)
        name = str(image.relative_to(root))
        size = image_size(image)
        frames.append(
            make_frame(name, image, pose, intrinsics, size, calibration, depth_path=depth, depth_unit=DEPTH_UNIT)
        )
    if not frames:
        got = f"{len(images)} images and {len(poses)} poses, none at the same time"
        raise refusal(str(path), wanted="images with poses", got=got, fix="use the groundtruth.txt of these images")
    num_lost = len(images) - len(frames)
    lost = [f"{num_lost} of {len(images)} frames are skipped: there is no pose at their time."] if num_lost else []
    again = [f"{num_again} lines of rgb.txt list an image again; its first time counts."] if num_again else []
    gone = [
        f"{number} files of {name} are missing and left out."
        for name, number in (("rgb.txt", num_gone), ("depth.txt", depths_gone))
        if number
    ]
    return list_frames(root.name, frames, [*lost, *again, *gone], is_in_time=True)


def _each_once(files: list[tuple[float, Path]]) -> tuple[list[tuple[float, Path]], int]:
    """Each file at its first time, and the number of entries that were left out."""
    first: dict[Path, float] = {}
    for time, file in files:
        first.setdefault(file, time)
    return [(time, file) for file, time in first.items()], len(files) - len(first)


def _files(root: Path, name: str, *, needed: bool = False) -> tuple[list[tuple[float, Path]], int]:
    """(time, file) of a list of files, in the order of time, and the number of listed files that do not exist.

    Raises:
        InputError: a line is damaged, or none of the files exists although they are `needed`.
    """
    found, missing = [], []
    for number, line in load_lines(root / name):
        if not line:
            continue
        where, words = f"{root / name}: line {number}", line.split(maxsplit=1)
        if len(words) != 2:
            raise refusal(where, wanted="a time and a file", got=echo(line), fix="write the file again")
        (time,) = parse_numbers(words[:1], where)
        file = find_named(root, words[1], where)
        if file is None:
            missing.append((words[1], where))
        else:
            found.append((time, file))
    if needed and missing and not found:
        file_named(root, *missing[0])  # refuses it
    return sorted(found), len(missing)


def _pose_at(time: float, poses: Float64[np.ndarray, "n 8"], where: str) -> Float64[np.ndarray, "4 4"] | None:
    """Camera-to-world pose at a time, interpolated between the poses around it; None if they are too far apart."""
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
    return pose_from_quat(quat, (1 - share) * a[1:4] + share * b[1:4], where)


def _depth_at(time: float, depths: list[tuple[float, Path]]) -> Path | None:
    """Depth map nearest in time, or None if none is within `MAX_DEPTH_GAP`."""
    places = range(*np.searchsorted([at for at, _ in depths], [time - MAX_DEPTH_GAP, time + MAX_DEPTH_GAP]))
    return min((depths[i] for i in places), key=lambda depth: abs(depth[0] - time), default=(0.0, None))[1]


def _intrinsics(root: Path) -> tuple[Intrinsics, str]:
    """Intrinsics of the color camera, and their location for error messages."""
    file = root / "calibration.txt"
    if file.is_file():
        where = str(file)
        values = parse_numbers([word for _, line in load_lines(file) for word in line.split()], where)
        if not 4 <= len(values) <= 9:
            got = f"{len(values)} numbers"
            raise refusal(where, wanted="fx fy cx cy [k1 k2 p1 p2 k3]", got=got, fix="write these numbers")
    else:
        found = re.search("freiburg[123]", root.name)
        if found is None:
            where, got = f"{root}: intrinsics", "neither calibration.txt nor freiburg1, 2 or 3 in the folder's name"
            raise refusal(where, wanted="a calibration", got=got, fix="write fx fy cx cy into calibration.txt")
        where, values = found[0], CALIBRATIONS[found[0]]
    fx, fy, cx, cy, *distortion = values
    lens = Lens(**dict(zip(("k1", "k2", "p1", "p2", "k3"), distortion, strict=False)))
    return Intrinsics(fx=fx, fy=fy, cx=cx + 0.5, cy=cy + 0.5, lens=lens), where
