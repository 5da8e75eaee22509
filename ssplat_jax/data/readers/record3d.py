"""Reader of Record3D's exports: `metadata.json` (or `metadata`) and the images `rgb/0.jpg` (or `rgbd/0.jpg`).

`poses` holds a unit quaternion (xyzw) and a camera center per image, camera-to-world with OpenGL axes, in meters.
`perFrameIntrinsicCoeffs`, where it is there, holds fx, fy, cx and cy per image, else `K` is the matrix of intrinsics of
all images, column by column; both in pixels of an image of `w` x `h`. Depth maps are not read: they are
floating-point EXR or compressed.
"""

from pathlib import Path

from ssplat_jax.core.errors import echo, refusal
from ssplat_jax.data.pose_conventions import Convention
from ssplat_jax.data.posed_image import pose_from_quat
from ssplat_jax.data.readers import Listing
from ssplat_jax.data.readers.frame_list import Intrinsics, find_file, list_frames, make_frame, stored_size
from ssplat_jax.data.readers.strict_json import JsonFields, load_json

FORMAT = "Record3D"
CONVENTION = Convention(axes="opengl")
FOLDERS = ("rgb", "rgbd")
FIX = "export the recording again"


def matches(path: Path) -> bool:
    """True if `path` is a folder with Record3D's metadata and a folder of images."""
    return _metadata(path) is not None and any((path / folder).is_dir() for folder in FOLDERS)


def read(path: Path) -> Listing:
    """Reads the images that exist; image `i.jpg` has pose `i`."""
    root, file = path.resolve(), _metadata(path)
    assert file is not None  # `matches` is true
    meta = load_json(file)
    fields, poses = JsonFields(meta, str(file)), meta.get("poses")
    if not isinstance(poses, list) or not poses:
        got = "nothing" if poses is None else echo(poses)
        raise refusal(f"{file}.poses", wanted="a list of poses", got=got, fix=FIX)
    intrinsics = _intrinsics(fields, meta.get("perFrameIntrinsicCoeffs"), len(poses))
    described = (fields.number("w"), fields.number("h"))
    frames = []
    for i, entry in enumerate(poses):
        where = f"{file}: poses[{i}]"
        names = [f"{folder}/{i}.{suffix}" for folder in FOLDERS for suffix in ("jpg", "png")]
        image = find_file(root, names, where)
        if image is None:
            continue
        x, y, z, w, *center = JsonFields({"pose": entry}, where).numbers("pose", (7,))
        opengl = pose_from_quat((w, x, y, z), center, where)
        size, shrink = stored_size(image, described, f"{file}: w, h", FIX)
        name = str(image.relative_to(root))
        frames.append(make_frame(name, image, CONVENTION.to_opencv(opengl), intrinsics[i], size, where, shrink=shrink))
    if not frames:
        raise refusal(str(path), wanted="images rgb/0.jpg, ...", got=f"none for {len(poses)} poses", fix=FIX)
    num_lost = len(poses) - len(frames)
    lost = [f"{num_lost} of {len(poses)} frames are skipped: their images are missing."] if num_lost else []
    return list_frames(root.name, frames, lost)


def _intrinsics(fields: JsonFields, per_frame: object, num_frames: int) -> list[Intrinsics]:
    """Intrinsics of each image: its own row of `per_frame`, or `K` where there are no such rows."""
    if per_frame is None:
        K = fields.numbers("K", (9,)).reshape(3, 3).T
        return [Intrinsics(fx=K[0, 0], fy=K[1, 1], cx=K[0, 2], cy=K[1, 2])] * num_frames
    rows = fields.numbers("perFrameIntrinsicCoeffs", (num_frames, 4))
    return [Intrinsics(fx=fx, fy=fy, cx=cx, cy=cy) for fx, fy, cx, cy in rows]


def _metadata(path: Path) -> Path | None:
    """File of the metadata in the folder `path`, or None."""
    return next((path / name for name in ("metadata.json", "metadata") if (path / name).is_file()), None)
