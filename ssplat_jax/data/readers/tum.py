"""Reader of TUM RGB-D sequences.

`rgb.txt` and `depth.txt` list times and files, `groundtruth.txt` camera-to-world poses (time, tx ty tz, qx qy qz qw).
The pose of an image is interpolated between its neighbors in time; images between poses more than `MAX_POSE_GAP` apart
are skipped, as are listed files that do not exist; an image that is listed at several times counts once, at the first.
Depth maps are in units of 1/5000 m, or of what a `DepthMapFactor` in a .yaml file (ORB-SLAM) or a `png_depth_scale` or
`scale` in a .json file (Replica) beside them says; an image gets the nearest one within `MAX_DEPTH_GAP`.
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
from ssplat_jax.data.images import Lens
from ssplat_jax.data.parsing import load_lines, load_rows, load_text, parse_numbers
from ssplat_jax.data.posed_image import pose_from_quat
from ssplat_jax.data.readers.frame_list import (
    FrameList,
    Intrinsics,
    Listing,
    file_named,
    files_in,
    find_image,
    name_in,
    stored_size,
)

FORMAT = "TUM RGB-D"
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


def matches(path: Path) -> bool:
    """True if `path` is a folder with `rgb.txt` and `groundtruth.txt`."""
    return (path / "rgb.txt").is_file() and (path / "groundtruth.txt").is_file()


def read(path: Path) -> Listing:
    """Reads the images of the sequence in the folder `path` whose poses are known."""
    root = path.resolve()
    intrinsics, calibration = _intrinsics(root)
    described = SIZE if calibration in CALIBRATIONS else None
    poses = load_rows(root / "groundtruth.txt", 8)
    poses = poses[np.isfinite(poses).all(axis=1)]  # others say that tracking was lost
    poses = poses[np.argsort(poses[:, 0], kind="stable")]
    listed, notes = _files(root, "rgb.txt")
    depths, depth_notes = _files(root, "depth.txt") if (root / "depth.txt").is_file() else ([], [])
    images = {file: time for time, file in reversed(listed)}  # each at its first time
    if len(images) < len(listed):
        again = len(listed) - len(images)
        notes = [f"{again} lines of rgb.txt list an image again; its first time counts.", *notes]
    factor = _depth_factor(root)
    if depths and factor is None and not re.search("freiburg[123]", root.name):
        depth_notes = [*depth_notes, "Depth maps are taken to be in steps of 1/5000 m, as TUM's are: no file says so."]
    unit = 1 / (factor or DEPTH_FACTOR)
    frames = FrameList(root)
    for image, time in sorted(images.items(), key=lambda item: item[::-1]):
        pose = _pose_at(time, poses, f"{root / 'groundtruth.txt'} at {time:.6f}")
        if pose is not None:
            name, sized, depth = (
                name_in(root, image),
                stored_size(image, described, calibration),
                _depth_at(time, depths),
            )
            frames.add(name, image, (pose, 0.0), intrinsics, sized, calibration, depth=depth, depth_unit=unit)
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


def _files(root: Path, name: str) -> tuple[list[tuple[float, Path]], list[str]]:
    """(time, file) of a list of files, in the order of time, and a note about listed files that do not exist."""
    found, missing = [], []
    for where, line in load_lines(root / name):
        if line:
            time, *file_name = line.split(maxsplit=1)
            if not file_name:
                raise refusal(where, wanted="a time and a file", got=echo(line), fix="write the file again")
            file = find_image(root, file_name[0], where)
            found.append((parse_numbers([time], where)[0], file))
            missing += [(file_name[0], where)] if file is None else []
    if missing and len(missing) == len(found) and name == "rgb.txt":
        file_named(root, *missing[0])  # refuses it
    notes = [f"{len(missing)} files of {name} are missing and left out."] if missing else []
    return sorted((time, file) for time, file in found if file is not None), notes


def _pose_at(time: float, poses: Float64[np.ndarray, "n 8"], where: str) -> Float64[np.ndarray, "4 4"] | None:
    """Camera-to-world pose at a time, interpolated between the poses around it; None if they are too far apart.

    The nearest of 100 poses per second would be up to 5 ms off.
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
    return pose_from_quat(quat, (1 - share) * a[1:4] + share * b[1:4], where)


def _depth_at(time: float, depths: list[tuple[float, Path]]) -> Path | None:
    """Depth map nearest in time, or None if none is within `MAX_DEPTH_GAP`."""
    places = range(*np.searchsorted([at for at, _ in depths], [time - MAX_DEPTH_GAP, time + MAX_DEPTH_GAP]))
    return min((depths[i] for i in places), key=lambda depth: abs(depth[0] - time), default=(0.0, None))[1]


def _intrinsics(root: Path) -> tuple[Intrinsics, str]:
    """Intrinsics of the color camera, and their location for messages."""
    file, named = root / "calibration.txt", re.search("freiburg[123]", root.name)
    where = str(file)
    if file.is_file():
        values = parse_numbers(load_text(file).split(), where)
        if not 4 <= len(values) <= 9:
            got = f"{len(values)} numbers"
            raise refusal(where, wanted="fx fy cx cy [k1 k2 p1 p2 k3]", got=got, fix="write these numbers")
    elif named:
        where, values = named[0], CALIBRATIONS[named[0]]
    else:
        got, fix = "neither it nor freiburg1, 2 or 3 in the folder's name", "write fx fy cx cy into the file"
        raise refusal(where, wanted="a calibration", got=got, fix=fix)
    fx, fy, cx, cy, *distortion = values
    lens = Lens(**dict(zip(("k1", "k2", "p1", "p2", "k3"), distortion, strict=False)))
    return Intrinsics(fx=fx, fy=fy, cx=cx + 0.5, cy=cy + 0.5, lens=lens), where
