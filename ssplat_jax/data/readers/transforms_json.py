"""Reader of `transforms.json` of nerfstudio, instant-ngp and Blender.

Poses are camera-to-world with OpenGL axes (+x right, +y up, +z backward) and are converted to OpenCV axes. They are not
re-centered or rescaled, and `applied_transform` is ignored, so results are in the frame of the file.
Intrinsics are global or per frame, and a frame's own value comes first: fl_x, fl_y, cx, cy, w, h in pixels of the
stored image, or camera_angle_x in radians. Defaults are fl_y = fl_x, the center of the image, and the size of the
image file. Distortion (k1 to k4, p1, p2) follows the Brown-Conrady model, or with `camera_model` OPENCV_FISHEYE or
`is_fisheye` the fish-eye model (k1 to k4), and is removed when images are delivered.
DL3DV keeps the file and its images in a folder `nerfstudio`, which is opened with the folder around it.
Frames are streamed in the natural order of `file_path`, with the exception in `frame_list.in_stream_order`.
"""

import dataclasses
import math
from pathlib import Path
from typing import Any

from ssplat_jax.core.errors import InputError, echo, refusal
from ssplat_jax.data.images import check_depth_header, image_size
from ssplat_jax.data.lens import FisheyeLens, Lens
from ssplat_jax.data.pose_conventions import Convention
from ssplat_jax.data.posed_image import Frame, check_camtoworld
from ssplat_jax.data.readers import Listing, splat_cameras
from ssplat_jax.data.readers.frame_list import (
    EXTENSIONS,
    SHRUNK_FOLDERS,
    Intrinsics,
    file_named,
    in_images,
    list_frames,
    make_frame,
    stored_size,
)
from ssplat_jax.data.readers.strict_json import load_json

FORMAT = "transforms.json"
CONVENTION = Convention(axes="opengl")
PLACES = ("transforms.json", "nerfstudio/transforms.json")
FOCAL_FIELDS = ("fl_x", "fl_y", "camera_angle_x", "camera_angle_y")
PINHOLE_MODELS = (None, "OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
FISHEYE_MODELS = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")


def matches(path: Path) -> bool:
    """True if `path` is a folder with a transforms.json, also in `nerfstudio`, or a .json file of an object."""
    if path.is_file():
        return path.suffix == ".json" and not splat_cameras.matches(path)
    return any((path / name).is_file() for name in PLACES)


def _file(path: Path) -> Path:
    """The file at `path` or in the folder `path`."""
    if path.is_file():
        return path
    return next((path / name for name in PLACES if (path / name).is_file()), path / PLACES[0])


def read(path: Path) -> Listing:
    """Reads the frames of the capture in the folder `path`, or of the file `path`."""
    return _read(path, None)


def read_complete(path: Path) -> tuple[Listing, str | None]:
    """Reads the frames before the first that cannot be read, of a capture that is still being written.

    Returns:
        The listing, and the reason why that frame cannot be read; None if all can.

    Raises:
        InputError: the file cannot be read, or no frame of it.
    """
    problems: list[str] = []
    listing = _read(path, problems)
    return listing, problems[0] if problems else None


def num_listed(path: Path) -> int:
    """Number of frames that the file lists, readable or not; 0 while the file itself cannot be read."""
    try:
        entries = load_json(_file(path)).get("frames")
    except InputError:
        return 0
    return len(entries) if isinstance(entries, list) else 0


def _read(path: Path, problems: list[str] | None) -> Listing:
    """The frames of a capture; with `problems`, those before the first problem, which is added to the list."""
    file = _file(path)
    root = file.parent.resolve()
    meta = load_json(file)
    entries = meta.get("frames")
    if not isinstance(entries, list) or not entries:
        got = "nothing" if "frames" not in meta else echo(entries)
        raise refusal(f"{file}: frames", wanted="a list of frames", got=got, fix="list one object per image")
    frames, fields_of = [], {}
    for i, entry in enumerate(entries):
        where = f"{file}: frames[{i}]"
        if not isinstance(entry, dict):
            raise refusal(where, wanted="an object", got=echo(entry), fix="give file_path and transform_matrix")
        try:
            frame = _read_frame(root, meta, entry, where)
        except InputError as error:
            if problems is None or not frames:
                raise
            problems.append(str(error))
            break
        first = fields_of.setdefault(frame.path, where)
        if first is not where:
            got = f"{echo(frame.name)} in both {first.split(': ')[-1]} and frames[{i}]"
            raise refusal(f"{where}.file_path", wanted="every image once", got=got, fix="drop one of the two frames")
        frames.append(frame)
    masked = sum(entry.get("mask_path") is not None for entry in entries if isinstance(entry, dict))
    unused = [f"{masked} frames have masks (mask_path), which are not used: all pixels count."] if masked else []
    return list_frames(root.name, frames, unused)


def _read_frame(root: Path, meta: dict[str, Any], entry: dict[str, Any], where: str) -> Frame:
    """Checked frame of one entry of the list `frames`."""
    name = entry.get("file_path")
    path = file_named(root, name, f"{where}.file_path", EXTENSIONS, SHRUNK_FOLDERS)
    depth_path = None
    if entry.get("depth_file_path") is not None:
        depth_path = file_named(root, entry["depth_file_path"], f"{where}.depth_file_path")
        check_depth_header(depth_path)
    if "transform_matrix" not in entry:
        fix = "give the camera-to-world matrix of the frame"
        raise refusal(f"{where}.transform_matrix", wanted="a 4x4 matrix", got="nothing", fix=fix)
    opengl, deviation = check_camtoworld(entry["transform_matrix"], f"{where}.transform_matrix")
    fields = _Fields(meta, entry, where)
    is_shrunk = path.relative_to(root).parts[0] in SHRUNK_FOLDERS and in_images(str(name)) is not None
    (width, height), shrink = _check_size(fields, path, is_shrunk=is_shrunk)
    fx, fy = _focal(fields, width / shrink, height / shrink)
    cx, cy = (fields.number(name, side / shrink / 2) for name, side in (("cx", width), ("cy", height)))
    lens = _lens(fields)
    return make_frame(
        str(name),
        path,
        CONVENTION.to_opencv(opengl),
        Intrinsics(fx=fx, fy=fy, cx=cx, cy=cy, lens=lens),
        (width, height),
        where,
        pose_deviation=deviation,
        shrink=shrink,
        depth_path=depth_path,
    )


class _Fields:
    """Fields of a frame; its own values come before the global ones."""

    def __init__(self, meta: dict[str, Any], entry: dict[str, Any], where: str) -> None:
        self._meta, self._entry, self.where = meta, entry, where

    def get(self, name: str, *, own: bool = False) -> Any:
        """Returns the value of a field, with `own` that of the frame alone, or None."""
        return self._entry.get(name, None if own else self._meta.get(name))

    def number(self, name: str, default: float) -> float:
        """Returns a field as float, or `default` if it is missing or null."""
        value = self.get(name)
        if value is None:
            return float(default)
        try:
            if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
                return float(value)
        except OverflowError:  # an integer too large for float64
            pass
        fix = "write a plain JSON number"
        raise refusal(f"{self.where}.{name}", wanted="a finite number", got=echo(value), fix=fix)


def _check_size(fields: _Fields, path: Path, *, is_shrunk: bool) -> tuple[tuple[int, int], float]:
    """Returns (width, height) of the stored image, and its size relative to the w and h of the intrinsics."""
    width, height = image_size(path)
    in_pixels = any(fields.get(name) is not None for name in ("fl_x", "fl_y", "cx", "cy"))
    if is_shrunk and in_pixels and None in (fields.get("w"), fields.get("h")):
        got = f"none, and {path.parent.name}/{path.name} of {width}x{height} in its place"
        fix = "add w and h, so that the intrinsics can be shrunk too"
        raise refusal(f"{fields.where}: w, h", wanted="the size of the image that is described", got=got, fix=fix)
    wanted = (fields.number("w", float(width)), fields.number("h", float(height)))
    fix = "set w and h to the stored size and scale fl_x, fl_y, cx, cy with them"
    return stored_size(path, wanted, f"{fields.where}: w, h", fix)


def _lens(fields: _Fields) -> Lens:
    """Distortion by the camera's model; models without one of OpenCV's two lenses are refused."""
    model, where = fields.get("camera_model"), f"{fields.where}: camera_model"
    flag = fields.get("is_fisheye")
    if flag not in (None, True, False):
        raise refusal(f"{fields.where}.is_fisheye", wanted="true or false", got=echo(flag), fix="write a JSON boolean")
    is_fisheye = model in FISHEYE_MODELS or bool(flag)
    coefficients = {field.name: fields.number(field.name, 0.0) for field in dataclasses.fields(Lens)}
    fix = "undistort the images to a pinhole camera first (COLMAP: `colmap image_undistorter`)"
    if not is_fisheye and model not in PINHOLE_MODELS:
        raise refusal(where, wanted="OPENCV, PINHOLE or OPENCV_FISHEYE", got=echo(model), fix=fix)
    if is_fisheye and (coefficients["p1"] or coefficients["p2"]):
        raise refusal(where, wanted="a fish-eye lens with k1 to k4 alone", got="p1 or p2 beside them", fix=fix)
    return FisheyeLens(**coefficients) if is_fisheye else Lens(**coefficients)


def _focal(fields: _Fields, width: float, height: float) -> tuple[float, float]:
    """Focal lengths in pixels, from fl_x and fl_y or the fields of view camera_angle_x and camera_angle_y."""
    focals, own = {}, {name for name in FOCAL_FIELDS if fields.get(name, own=True) is not None}
    # The frame's own fields come first. If these are angles alone, a focal length of the file is of another camera.
    sources = (True,) if own and own.isdisjoint(("fl_x", "fl_y")) else (True, False)
    for axis, extent in (("x", width), ("y", height)):
        kinds = [(kind, own) for own in sources for kind in ("fl", "camera_angle")]
        kind = next((kind for kind, own in kinds if fields.get(f"{kind}_{axis}", own=own) is not None), None)
        if kind == "fl":
            focals[axis] = fields.number(f"fl_{axis}", 0.0)
        elif kind is not None:
            angle = fields.number(f"camera_angle_{axis}", 0.0)
            if not (0 < angle < math.pi and math.tan(angle / 2) > 0):
                where = f"{fields.where}.camera_angle_{axis}"
                raise refusal(where, wanted="an angle in (0, pi)", got=echo(angle), fix="give it in radians")
            focals[axis] = extent / (2 * math.tan(angle / 2))
    if not focals:
        fix = "give fl_x in pixels or camera_angle_x in radians"
        raise refusal(f"{fields.where}.fl_x", wanted="a focal length", got="nothing", fix=fix)
    return focals.get("x", focals.get("y", 0.0)), focals.get("y", focals.get("x", 0.0))
