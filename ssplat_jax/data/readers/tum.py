"""TUM RGB-D: `rgb.txt` and `depth.txt` (time, file), `groundtruth.txt` (time, tx ty tz, qx qy qz qw camera-to-world).

The pose of an image is interpolated between its two neighbors in time; images without neighbors closer than
`LONGEST_GAP` are left out. Depth maps are of 1/5000 m, the nearest within `DEPTH_GAP` counts.
Intrinsics: `calibration.txt` (fx fy cx cy, and k1 k2 p1 p2 k3 if there), else, by the `freiburg1` to `freiburg3` in
the folder's name, those of the color camera in cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats. They count
pixels from the first one's center; half a pixel is added.
"""

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from ssplat_jax.data.images import check_depth_header, image_size
from ssplat_jax.data.lens import Lens
from ssplat_jax.data.posed_image import pose_of
from ssplat_jax.data.readers import Listing
from ssplat_jax.data.readers.frame_list import Intrinsics, file_named, make_frame, streamed
from ssplat_jax.data.readers.strict_text import load_lines, load_rows, numbers
from ssplat_jax.errors import echo, refusal

FORMAT = "TUM RGB-D"
LONGEST_GAP = 0.1  # seconds between the two poses that an image lies between
DEPTH_GAP = 0.02  # seconds from an image to its depth map
DEPTH_UNIT = 1 / 5000
CALIBRATIONS = {  # fx fy cx cy k1 k2 p1 p2 k3
    "freiburg1": (517.3, 516.5, 318.6, 255.3, 0.2624, -0.9531, -0.0054, 0.0026, 1.1633),
    "freiburg2": (520.9, 521.0, 325.1, 249.7, 0.2312, -0.7849, -0.0033, -0.0001, 0.9172),
    "freiburg3": (535.4, 539.2, 320.1, 247.6),
}


def matches(path: Path) -> bool:
    """Whether `path` is a folder with `rgb.txt` and `groundtruth.txt`."""
    return (path / "rgb.txt").is_file() and (path / "groundtruth.txt").is_file()


def read(path: Path) -> Listing:
    """The images of the sequence in the folder `path` whose poses are known."""
    root = path.resolve()
    intrinsics, calibration = _intrinsics(root)
    poses = load_rows(root / "groundtruth.txt", 8)
    poses = poses[np.argsort(poses[:, 0], kind="stable")]
    images = _files(root, "rgb.txt")
    depths = _files(root, "depth.txt") if (root / "depth.txt").is_file() else []
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
        got = f"{len(images)} images and {len(poses)} poses, none at one time"
        raise refusal(str(path), wanted="images with poses", got=got, fix="use the groundtruth.txt of these images")
    num_lost = len(images) - len(frames)
    lost = [f"{num_lost} of {len(images)} frames are left out: no pose is known at their time."] if num_lost else []
    return streamed(root.name, frames, lost, in_time=True)


def _files(root: Path, name: str) -> list[tuple[float, Path]]:
    """(time, file) in order of time."""
    found = []
    for number, line in load_lines(root / name):
        if not line:
            continue
        where, words = f"{root / name}: line {number}", line.split(maxsplit=1)
        if len(words) != 2:
            raise refusal(where, wanted="a time and a file", got=echo(line), fix="write the file anew")
        (time,) = numbers(words[:1], where)
        found.append((time, file_named(root, words[1], where)))
    return sorted(found)


def _pose_at(time: float, poses: Float64[np.ndarray, "n 8"], where: str) -> Float64[np.ndarray, "4 4"] | None:
    """The camera-to-world pose at a time, between the two poses around it."""
    before, after = (int(np.searchsorted(poses[:, 0], time, side)) for side in ("right", "left"))
    before -= 1  # the pose of just this time, if there is one, is both
    if before < 0 or after >= len(poses) or poses[after, 0] - poses[before, 0] > LONGEST_GAP:
        return None
    a, b = poses[before], poses[after]
    share = (time - a[0]) / (b[0] - a[0]) if b[0] > a[0] else 0.0
    quat_a, quat_b = a[[7, 4, 5, 6]], b[[7, 4, 5, 6]]  # wxyz
    # Along the chord: within a tenth of a second that is the arc to some millionths.
    quat = (1 - share) * quat_a + share * np.copysign(1.0, quat_a @ quat_b) * quat_b
    return pose_of(quat, (1 - share) * a[1:4] + share * b[1:4], where)


def _depth_at(time: float, depths: list[tuple[float, Path]]) -> Path | None:
    """The depth map nearest in time, if it is near enough."""
    places = range(*np.searchsorted([at for at, _ in depths], [time - DEPTH_GAP, time + DEPTH_GAP]))
    return min((depths[i] for i in places), key=lambda depth: abs(depth[0] - time), default=(0.0, None))[1]


def _intrinsics(root: Path) -> tuple[Intrinsics, str]:
    """The color camera's, and where they stand."""
    file = root / "calibration.txt"
    if file.is_file():
        where = str(file)
        values = numbers([word for _, line in load_lines(file) for word in line.split()], where)
        if not 4 <= len(values) <= 9:
            got = f"{len(values)} numbers"
            raise refusal(where, wanted="fx fy cx cy [k1 k2 p1 p2 k3]", got=got, fix="write it so")
    else:
        found = re.search("freiburg[123]", root.name)
        if found is None:
            where, got = f"{root}: intrinsics", "neither calibration.txt nor freiburg1, 2 or 3 in the folder's name"
            raise refusal(where, wanted="a calibration", got=got, fix="write fx fy cx cy into calibration.txt")
        where, values = found[0], CALIBRATIONS[found[0]]
    fx, fy, cx, cy, *distortion = values
    lens = Lens(**dict(zip(("k1", "k2", "p1", "p2", "k3"), distortion, strict=False)))
    return Intrinsics(fx=fx, fy=fy, cx=cx + 0.5, cy=cy + 0.5, lens=lens), where
