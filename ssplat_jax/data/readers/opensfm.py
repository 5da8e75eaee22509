"""Reader of OpenSfM (and ODM): `reconstruction.json` and `images/`; ODM keeps them in `opensfm/` and `images/`.

The reconstruction with the most images is read. A shot has an axis-angle vector and a translation, world-to-camera with
OpenCV axes. A camera has its focal length and center in units of the longer side, the center relative to the middle of
the image. The models perspective, brown and fisheye (with k1 and k2) are supported.
"""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from ssplat_jax.core.errors import echo, refusal
from ssplat_jax.data.lens import FisheyeLens, Lens
from ssplat_jax.data.pose_conventions import Convention
from ssplat_jax.data.posed_image import pose_from_quat
from ssplat_jax.data.readers import Listing
from ssplat_jax.data.readers.frame_list import (
    SHRUNK_FOLDERS,
    Intrinsics,
    file_named,
    list_frames,
    make_frame,
    stored_size,
)
from ssplat_jax.data.readers.strict_json import JsonFields, load_json_list

FORMAT = "OpenSfM"
CONVENTION = Convention(poses="world-to-camera")
PLACES = ("reconstruction.json", "opensfm/reconstruction.json")
FIX = "write it again with OpenSfM"


def matches(path: Path) -> bool:
    """True if `path` is a folder with a reconstruction.json, also in `opensfm`."""
    return any((path / place).is_file() for place in PLACES)


def read(path: Path) -> Listing:
    """Reads the shots of the largest reconstruction."""
    root = path.resolve()
    file = next(path / place for place in PLACES if (path / place).is_file())
    models = load_json_list(file)
    sizes = [len(shots) if isinstance(shots := model.get("shots"), dict) else 0 for model in models]
    largest = int(np.argmax(sizes))
    shots, cameras, where = models[largest].get("shots"), models[largest].get("cameras"), f"{file}: [{largest}]"
    if not isinstance(shots, dict) or not shots or not isinstance(cameras, dict):
        raise refusal(where, wanted="cameras and shots", got="none", fix=FIX)
    frames = []
    for name, entry in shots.items():
        fields = JsonFields(_object(entry, f"{where}.shots.{echo(name)}"), f"{where}.shots.{echo(name)}")
        camera = _object(cameras.get(fields.text("camera")), f"{fields.where}.camera")
        described, intrinsics = _intrinsics(JsonFields(camera, f"{fields.where}.camera"))
        image = file_named(root, f"images/{name}", fields.where, folders=SHRUNK_FOLDERS)
        size, shrink = stored_size(image, described, fields.where, "use the images that OpenSfM used")
        quat = _quat_of_axis_angle(fields.numbers("rotation", (3,)))
        pose = CONVENTION.to_opencv(pose_from_quat(quat, fields.numbers("translation", (3,)), fields.where))
        frames.append(make_frame(name, image, pose, intrinsics, size, fields.where, shrink=shrink))
    num_left = sum(sizes) - len(frames)
    left = [f"{num_left} images of smaller reconstructions, which are not connected, are skipped."] if num_left else []
    return list_frames(root.name, frames, left)


def _object(value: object, where: str) -> dict[str, Any]:
    """A checked JSON object."""
    if isinstance(value, dict):
        return value
    raise refusal(where, wanted="an object", got="nothing" if value is None else echo(value), fix=FIX)


def _intrinsics(camera: JsonFields) -> tuple[tuple[float, float], Intrinsics]:
    """Described (width, height), and intrinsics in pixels."""
    width, height = camera.number("width"), camera.number("height")
    longer = max(width, height)
    kind, names = camera.text("projection_type"), ("k1", "k2", "k3", "p1", "p2")
    if kind not in ("perspective", "brown", "fisheye"):
        fix = "undistort the images with OpenSfM first"
        raise refusal(
            f"{camera.where}.projection_type", wanted="perspective, brown or fisheye", got=echo(kind), fix=fix
        )
    lens = {name: camera.number(name, 0.0) for name in (names if kind == "brown" else names[:2])}
    fx, fy = (camera.number("focal") if camera.has("focal") else camera.number(f"focal_{axis}") for axis in "xy")
    intrinsics = Intrinsics(
        fx=fx * longer,
        fy=fy * longer,
        cx=camera.number("c_x", 0.0) * longer + width / 2,
        cy=camera.number("c_y", 0.0) * longer + height / 2,
        lens=FisheyeLens(**lens) if kind == "fisheye" else Lens(**lens),
    )
    return (width, height), intrinsics


def _quat_of_axis_angle(vector: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "4"]:
    """Unit quaternion (wxyz) of an axis times an angle in radians."""
    angle = float(np.linalg.norm(vector))
    return np.array([np.cos(angle / 2), *(np.sinc(angle / 2 / np.pi) / 2 * vector)])
