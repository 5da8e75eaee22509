"""Reader of Polycam's raw data: in `keyframes/`, `images/1.jpg` and `cameras/1.json`, and optionally `depth/1.png`.

Where Polycam has optimized the poses, `corrected_images` and `corrected_cameras` are read instead. `t_00` to `t_23` are
the camera-to-world matrix row by row, in meters, with OpenGL axes in ARKit's world (+y up); `fx fy cx cy width height`
are in pixels. Depth maps hold millimeters and have their own resolution.
"""

from collections.abc import Iterator
from pathlib import Path

from ssplat_jax.data.parsing import Fields, load_json
from ssplat_jax.data.posed_image import Convention, check_camtoworld
from ssplat_jax.data.readers.frame_list import (
    UNDISTORT,
    FrameList,
    Intrinsics,
    Listing,
    find_file,
    images_in,
    stored_size,
)

FORMAT = "Polycam"
CONVENTION = Convention(axes="opengl")


def matches(path: Path) -> bool:
    """True if `path` is a folder with `keyframes/`, or that folder, with images and cameras in it."""
    return any(_keyframes(path))


def read(path: Path) -> Listing:
    """Reads the keyframes that have both an image and a camera."""
    keyframes, prefix = next(_keyframes(path.resolve()))
    images = images_in(keyframes / f"{prefix}images")
    frames = FrameList(path.resolve(), CONVENTION)
    for image in images:
        file = find_file(keyframes, [f"{prefix}cameras/{image.stem}.json"], str(image))
        if file is None:
            continue
        fields = Fields(load_json(file), str(file))
        pose = check_camtoworld([[fields.number(f"t_{i}{j}") for j in range(4)] for i in range(3)], str(file))
        fields.refuse("k1", "k2", "k3", "p1", "p2", "distortion", fix=UNDISTORT)
        fx, fy, cx, cy = (fields.number(name) for name in ("fx", "fy", "cx", "cy"))
        sized = stored_size(image, (fields.number("width"), fields.number("height")), f"{file}: width, height")
        depth = None if prefix else find_file(keyframes, [f"depth/{image.stem}.png"], str(image))
        intrinsics = Intrinsics(fx=fx, fy=fy, cx=cx, cy=cy)
        frames.add(image.name, image, pose, intrinsics, sized, str(file), key=image.stem, depth=depth)
    return frames.listing(len(images), "camera")


def _keyframes(path: Path) -> Iterator[tuple[Path, str]]:
    """Folders of keyframes, and the prefix of the folders in them, "corrected_" or none."""
    for folder in (path / "keyframes", path):
        for prefix in ("corrected_", ""):
            if all((folder / f"{prefix}{kind}").is_dir() for kind in ("images", "cameras")):
                yield folder.resolve(), prefix
