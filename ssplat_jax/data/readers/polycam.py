"""Reader of Polycam's raw data: in `keyframes/`, `images/1.jpg` and `cameras/1.json`, and optionally `depth/1.png`.

Where Polycam has optimized the poses, `corrected_images` and `corrected_cameras` are read instead. `t_00` to `t_23` are
the camera-to-world matrix row by row, in meters, with OpenGL axes in ARKit's world (+y up); `fx fy cx cy width height`
are in pixels. Depth maps hold millimeters and have their own resolution.
"""

from pathlib import Path

from ssplat_jax.core.errors import refusal
from ssplat_jax.data.images import check_depth_header
from ssplat_jax.data.pose_conventions import Convention
from ssplat_jax.data.posed_image import check_camtoworld
from ssplat_jax.data.readers import Listing
from ssplat_jax.data.readers.frame_list import (
    Intrinsics,
    check_once,
    find_file,
    list_frames,
    make_frame,
    stored_size,
)
from ssplat_jax.data.readers.strict_json import JsonFields, load_json

FORMAT = "Polycam"
CONVENTION = Convention(axes="opengl")
IMAGES = frozenset({".jpg", ".jpeg", ".png"})


def matches(path: Path) -> bool:
    """True if `path` is a folder with `keyframes/`, or that folder, with images and cameras in it."""
    return _keyframes(path) is not None


def read(path: Path) -> Listing:
    """Reads the keyframes that have both an image and a camera."""
    found = _keyframes(path)
    assert found is not None  # `matches` is true
    keyframes, prefix = found
    images = sorted(file for file in (keyframes / f"{prefix}images").glob("*") if file.suffix.lower() in IMAGES)
    frames, seen = [], dict[Path, str]()
    for image in images:
        check_once(seen, image.with_suffix(""), image.name, f"{image.parent}: {image.name}")
        file = find_file(keyframes, [f"{prefix}cameras/{image.stem}.json"], str(image))
        if file is None:
            continue
        fields = JsonFields(load_json(file), str(file))
        rows = [[fields.number(f"t_{row}{column}") for column in range(4)] for row in range(3)]
        opengl, deviation = check_camtoworld(rows, str(file))
        described = (fields.number("width"), fields.number("height"))
        fix = "export the raw data again"
        size, shrink = stored_size(image, described, f"{file}: width, height", fix)
        depth = None if prefix else find_file(keyframes, [f"depth/{image.stem}.png"], str(image))
        if depth is not None:
            check_depth_header(depth)
        fx, fy, cx, cy = (fields.number(name) for name in ("fx", "fy", "cx", "cy"))
        frames.append(
            make_frame(
                image.name,
                image,
                CONVENTION.to_opencv(opengl),
                Intrinsics(fx=fx, fy=fy, cx=cx, cy=cy),
                size,
                str(file),
                pose_deviation=deviation,
                shrink=shrink,
                depth_path=depth,
            )
        )
    if not frames:
        got, fix = f"{len(images)} images, none of them with a camera", "export the raw data again"
        raise refusal(str(keyframes), wanted="images with cameras", got=got, fix=fix)
    num_lost = len(images) - len(frames)
    lost = [f"{num_lost} of {len(images)} images are skipped: they have no camera."] if num_lost else []
    return list_frames(path.resolve().name, frames, lost)


def _keyframes(path: Path) -> tuple[Path, str] | None:
    """Folder of the keyframes, and the prefix of the folders in it, "corrected_" or none; None if there is none."""
    for folder in (path / "keyframes", path):
        for prefix in ("corrected_", ""):
            if all((folder / f"{prefix}{kind}").is_dir() for kind in ("images", "cameras")):
                return folder.resolve(), prefix
    return None
