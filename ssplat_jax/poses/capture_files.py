"""Files of a capture from a reconstruction: `sparse/0`, `sparse/1`, ... of COLMAP, and `transforms.json`."""

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ssplat_jax.data.posed_image import OPENGL_TO_OPENCV, invert_pose
from ssplat_jax.storage.files import write_json

LENS_PARAMETERS = {"OPENCV": ("k1", "k2", "p1", "p2"), "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4")}


def write_sparse(out: Path, models: Sequence[Any]) -> None:
    """Writes reconstructions to `out/sparse/0`, `out/sparse/1`, ... in COLMAP's binary format.

    The folder `sparse` appears when it is complete.
    """
    partial = out / "sparse.partial"
    shutil.rmtree(partial, ignore_errors=True)
    for number, model in enumerate(models):
        (partial / str(number)).mkdir(parents=True)
        model.write(partial / str(number))
    shutil.rmtree(out / "sparse", ignore_errors=True)
    partial.rename(out / "sparse")


def write_transforms(out: Path, model: Any) -> None:
    """Writes `out/transforms.json` of the registered images of a reconstruction, in the order of their names.

    Poses are camera-to-world with OpenGL axes, in the reconstruction's frame and unit; intrinsics are in pixels with
    the center of the first pixel at (0.5, 0.5), which is COLMAP's convention too. They are global where all images
    share a camera, as those of a video do, and otherwise per image.
    """
    images = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.name)
    cameras = {key: camera_fields(camera) for key, camera in model.cameras.items()}
    used = {image.camera_id for image in images}
    shared = cameras[used.pop()] if len(used) == 1 else {}
    frames = [
        {
            "file_path": f"images/{image.name}",
            "transform_matrix": _camtoworld_opengl(image).tolist(),
            **({} if shared else cameras[image.camera_id]),
        }
        for image in images
    ]
    write_json(out / "transforms.json", {**shared, "frames": frames})


def camera_fields(camera: Any) -> dict[str, Any]:
    """Fields of transforms.json of a camera of model OPENCV or OPENCV_FISHEYE."""
    fx, fy, cx, cy, *lens = (float(value) for value in camera.params)
    fields: dict[str, Any] = {"camera_model": camera.model_name, "w": camera.width, "h": camera.height}
    names = LENS_PARAMETERS[camera.model_name]
    return {**fields, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, **dict(zip(names, lens, strict=True))}


def _camtoworld_opengl(image: Any) -> np.ndarray:
    """Camera-to-world matrix of an image, with OpenGL axes."""
    worldtocam = np.vstack([image.cam_from_world().matrix(), [0.0, 0.0, 0.0, 1.0]])
    return invert_pose(worldtocam) @ OPENGL_TO_OPENCV
