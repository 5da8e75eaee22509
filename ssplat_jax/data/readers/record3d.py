"""Reader of Record3D's exports: `metadata.json` (or `metadata`) and the images `rgb/0.jpg` (or `rgbd/0.jpg`).

`poses` holds a unit quaternion (xyzw) and a camera center per image, camera-to-world with OpenGL axes, in meters.
`perFrameIntrinsicCoeffs`, where it is there, holds fx, fy, cx and cy per image, else `K` is the matrix of intrinsics of
all images, column by column; both in pixels of an image of `w` x `h`. Depth maps are not read: they are
floating-point EXR or compressed.
"""

from pathlib import Path

from ssplat_jax.data.parsing import Fields, load_json
from ssplat_jax.data.posed_image import Convention, pose_from_quat
from ssplat_jax.data.readers.frame_list import (
    FrameList,
    Intrinsics,
    Listing,
    find_file,
    name_in,
    pinhole,
    stored_size,
)

FORMAT = "Record3D"
CONVENTION = Convention(axes="opengl")
FOLDERS = ("rgb", "rgbd")
FILES = ("metadata.json", "metadata")


def matches(path: Path) -> bool:
    """True if `path` is a folder with Record3D's metadata and a folder of images."""
    return any((path / name).is_file() for name in FILES) and any((path / folder).is_dir() for folder in FOLDERS)


def read(path: Path) -> Listing:
    """Reads the images that exist; image `i.jpg` has pose `i`."""
    root, file = path.resolve(), next(path / name for name in FILES if (path / name).is_file())
    meta = Fields(load_json(file), str(file))
    poses = meta.entries("poses")
    if meta.get("perFrameIntrinsicCoeffs") is None:
        shared = pinhole(meta.numbers("K", (9,)).reshape(3, 3).T, f"{file}: K")
        intrinsics = [shared] * len(poses)
    else:
        intrinsics = [Intrinsics(*row) for row in meta.numbers("perFrameIntrinsicCoeffs", (len(poses), 4)).tolist()]
    described = (meta.number("w"), meta.number("h"))
    frames = FrameList(root, CONVENTION)
    for i, (entry, intrinsic) in enumerate(zip(poses, intrinsics, strict=True)):
        where = f"{file}: poses[{i}]"
        names = [f"{folder}/{i}.{suffix}" for folder in FOLDERS for suffix in ("jpg", "png")]
        image = find_file(root, names, where)
        if image is not None:
            x, y, z, w, *center = Fields({"pose": entry}, where).numbers("pose", (7,))
            pose = (pose_from_quat((w, x, y, z), center, where), 0.0)
            sized = stored_size(image, described, f"{file}: w, h")
            frames.add(name_in(root, image), image, pose, intrinsic, sized, where)
    return frames.listing(len(poses), "image")
