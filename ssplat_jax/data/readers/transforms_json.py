"""nerfstudio / instant-ngp / Blender `transforms.json`.

Poses are camera-to-world with OpenGL axes (+x right, +y up, +z backward); here they become OpenCV's. They are otherwise
left alone: no re-centring, no rescaling, no `applied_transform`, so results stand in the file's own frame.
Intrinsics are global or per frame, a frame's own value first: fl_x, fl_y, cx, cy, w, h in pixels of the stored image,
or camera_angle_x in radians. Absent: fl_y = fl_x, centre of the image, size from the image's header. Distortion (k1 to
k4, p1, p2) is Brown's, and is undone when images are delivered.
Frames are streamed in the natural order of `file_path` ("9.jpg" before "10.jpg"), whatever their order in the file,
unless the file's order makes the camera's way less than half as long (names without an order, several cameras).
"""

import dataclasses
import itertools
import math
import re
from pathlib import Path
from typing import Any

import numpy as np

from ssplat_jax.data.lens import IGNORED_PX, Lens, check_lens
from ssplat_jax.data.pixels import check_depth_header, image_size
from ssplat_jax.data.posed_frame import (
    ROTATION_ROUNDING,
    Frame,
    check_camtoworld,
    check_intrinsics,
)
from ssplat_jax.data.readers import Listing
from ssplat_jax.data.readers.strict_json import load_json
from ssplat_jax.data.refusal import echo, refusal

FORMAT = "transforms.json"
OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
MUCH_SHORTER = 0.5  # of the camera's way by name: the file's order is taken
EXTENSIONS = ("", ".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG", ".webp")
SHRUNK_FOLDERS = ("images_2", "images_4", "images_8")  # where images/ was left out of a download
PINHOLE_MODELS = (None, "OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")


def matches(path: Path) -> bool:
    """Whether `path` is a folder with a transforms.json, or such a file under any name."""
    return (path / "transforms.json").is_file() or (path.is_file() and path.suffix == ".json")


def read(path: Path) -> Listing:
    """The frames of the capture in the folder `path`, or of the file `path` in its folder."""
    file = path if path.is_file() else path / "transforms.json"
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
        frame = _read_frame(root, meta, entry, where)
        first = fields_of.setdefault(frame.path, where)
        if first is not where:
            got = f"{echo(frame.name)} in both {first.split(': ')[-1]} and frames[{i}]"
            raise refusal(f"{where}.file_path", wanted="every image once", got=got, fix="drop one of the two frames")
        frames.append(frame)
    ordered = sorted(frames, key=lambda frame: _natural(frame.name))
    if _path_length(frames) < MUCH_SHORTER * _path_length(ordered):
        note = "Frames are streamed in the file's order: by name, the camera would go more than twice as far."
        return Listing(name=root.name, frames=tuple(frames), notes=(*_notes(frames), note))
    return Listing(name=root.name, frames=tuple(ordered), notes=_notes(frames))


def _path_length(frames: list[Frame]) -> float:
    """How far the camera goes from frame to frame."""
    return sum(math.dist(a.center, b.center) for a, b in itertools.pairwise(frames))


def _read_frame(root: Path, meta: dict[str, Any], entry: dict[str, Any], where: str) -> Frame:
    """One checked frame."""
    name = entry.get("file_path")
    path = _inside(root, name, f"{where}.file_path", EXTENSIONS, SHRUNK_FOLDERS)
    depth_path = None
    if "depth_file_path" in entry:
        depth_path = _inside(root, entry["depth_file_path"], f"{where}.depth_file_path", ("",))
        check_depth_header(depth_path)
    if "transform_matrix" not in entry:
        fix = "give the camera-to-world matrix of the frame"
        raise refusal(f"{where}.transform_matrix", wanted="a 4x4 matrix", got="nothing", fix=fix)
    opengl, deviation = check_camtoworld(entry["transform_matrix"], f"{where}.transform_matrix")
    fields = _Fields(meta, entry, where)
    is_shrunk = path.relative_to(root).parts[0] in SHRUNK_FOLDERS and str(name).startswith("images/")
    (width, height), shrink = _check_size(fields, path, is_shrunk=is_shrunk)
    _check_model(fields)
    fx, fy = (shrink * focal for focal in _focal(fields, width / shrink, height / shrink))
    cx, cy = (shrink * fields.number(name, side / shrink / 2) for name, side in (("cx", width), ("cy", height)))
    K = check_intrinsics(fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height, where=where)
    lens = Lens(**{field.name: fields.number(field.name, 0.0) for field in dataclasses.fields(Lens)})
    distortion_px = check_lens(lens, K, width, height, where)
    return Frame(
        name=str(name),
        camtoworld=opengl @ OPENGL_TO_OPENCV,
        K=K,
        width=width,
        height=height,
        path=path,
        depth_path=depth_path,
        pose_deviation=deviation,
        shrink=shrink,
        lens=lens if distortion_px > IGNORED_PX else None,
        distortion_px=distortion_px,
    )


class _Fields:
    """A frame's own fields before the file's global ones."""

    def __init__(self, meta: dict[str, Any], entry: dict[str, Any], where: str) -> None:
        self._meta, self._entry, self.where = meta, entry, where

    def get(self, name: str) -> Any:
        return self._entry.get(name, self._meta.get(name))

    def number(self, name: str, default: float) -> float:
        """The field as float64; `default` where absent or null."""
        value = self.get(name)
        if value is None:
            return float(default)
        try:
            if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
                return float(value)
        except OverflowError:  # an integer beyond float64
            pass
        fix = "write a plain JSON number"
        raise refusal(f"{self.where}.{name}", wanted="a finite number", got=echo(value), fix=fix)


def _inside(root: Path, name: object, where: str, extensions: tuple[str, ...], folders: tuple[str, ...] = ()) -> Path:
    """The file `name` of the capture, its extension completed; symbolic links are followed before it is judged.

    A name in images/ may lie in one of `folders` instead.
    """
    if not isinstance(name, str) or not name or "\0" in name:
        raise refusal(where, wanted="the path of a file", got=echo(name), fix="give it relative to the capture")
    names = [name, *(folder + name.removeprefix("images") for folder in folders if name.startswith("images/"))]
    for candidate in (n + extension for n in names for extension in extensions):
        try:
            path = (root / candidate).resolve()
            found = path.is_file()
        except (OSError, RuntimeError, ValueError):  # too long a name, a loop of links
            continue
        if not path.is_relative_to(root):
            fix = "copy the file into the capture's folder and give its relative path"
            raise refusal(where, wanted=f"a path inside {root}", got=echo(name), fix=fix)
        if found:
            return path
    got = f"{echo(name)}, which does not exist"
    raise refusal(where, wanted="an existing file", got=got, fix="add the file or drop the frame")


def _check_size(fields: _Fields, path: Path, *, is_shrunk: bool) -> tuple[tuple[int, int], float]:
    """(width, height) of the stored image, and how much smaller it is than the w and h of its intrinsics.

    Folders of shrunk images (nerfstudio's images_2, images_4) keep the intrinsics of the full size: both sides shrunk
    alike, to a pixel, are taken for such. Larger images than described are not.
    """
    width, height = image_size(path)
    in_pixels = any(fields.get(name) is not None for name in ("fl_x", "fl_y", "cx", "cy"))
    if is_shrunk and in_pixels and None in (fields.get("w"), fields.get("h")):
        got = f"none, and {path.parent.name}/{path.name} of {width}x{height} in its place"
        fix = "add w and h, so that the intrinsics can be shrunk too"
        raise refusal(f"{fields.where}: w, h", wanted="the size of the image that is described", got=got, fix=fix)
    wanted = (fields.number("w", float(width)), fields.number("h", float(height)))
    if wanted == (width, height):
        return (width, height), 1.0
    shrink = max(width, height) / max(*wanted, 1e-9)  # the longer side is rounded less
    if shrink < 1 and all(abs(w * shrink - side) <= 1.0 for w, side in zip(wanted, (width, height), strict=True)):
        return (width, height), shrink
    fix = "set w and h to the stored size and scale fl_x, fl_y, cx, cy with them"
    if wanted == (height, width):
        fix = "the image lies on its side: rotate the file (EXIF orientation is not applied) or swap the intrinsics"
    came = f"{width}x{height} in {path.name}"
    raise refusal(f"{fields.where}: w, h", wanted=f"{wanted[0]:g}x{wanted[1]:g}", got=came, fix=fix)


def _check_model(fields: _Fields) -> None:
    model = fields.get("camera_model")
    if model not in PINHOLE_MODELS or fields.get("is_fisheye"):
        fix = "undistort the images to a pinhole camera first (COLMAP: `colmap image_undistorter`)"
        raise refusal(
            f"{fields.where}: camera_model", wanted="OPENCV or PINHOLE", got=echo(model or "is_fisheye"), fix=fix
        )


def _focal(fields: _Fields, width: float, height: float) -> tuple[float, float]:
    """Focal lengths in pixels from fl_x, fl_y, or the fields of view camera_angle_x, camera_angle_y."""
    focals = {}
    for axis, extent in (("x", width), ("y", height)):
        if fields.get(f"fl_{axis}") is not None:
            focals[axis] = fields.number(f"fl_{axis}", 0.0)
        elif fields.get(f"camera_angle_{axis}") is not None:
            angle = fields.number(f"camera_angle_{axis}", 0.0)
            if not 0 < angle < math.pi:
                where = f"{fields.where}.camera_angle_{axis}"
                raise refusal(where, wanted="an angle in (0, pi)", got=echo(angle), fix="give it in radians")
            focals[axis] = extent / (2 * math.tan(angle / 2))
    if not focals:
        fix = "give fl_x in pixels or camera_angle_x in radians"
        raise refusal(f"{fields.where}.fl_x", wanted="a focal length", got="nothing", fix=fix)
    return focals.get("x", focals.get("y", 0.0)), focals.get("y", focals.get("x", 0.0))


def _natural(name: str) -> list[tuple[int, int, str]]:
    """Sort key in which digits count as numbers."""
    parts = re.split(r"([0-9]+)", name)  # every second part is a number
    return [(0, int(part), "") if k % 2 else (1, 0, part) for k, part in enumerate(parts)]


def _notes(frames: list[Frame]) -> tuple[str, ...]:
    notes = []
    off = [f for f in frames if f.pose_deviation > ROTATION_ROUNDING]
    if off:
        worst = max(f.pose_deviation for f in off)
        notes.append(
            f"{len(off)} poses were not quite rotations (by up to {worst:.1e}) and were projected to the nearest."
        )
    if shrinks := {f.shrink for f in frames if f.shrink != 1.0}:
        notes.append(f"Images are {min(shrinks):.4g} times the size of the intrinsics, which were scaled with them.")
    for what, kind in (("undone", [f for f in frames if f.lens]), ("ignored", [f for f in frames if not f.lens])):
        worst_px = max((f.distortion_px for f in kind), default=0.0)
        if worst_px > 0:
            notes.append(f"Lens distortion of up to {worst_px:.2f} px is {what}.")
    return tuple(notes)
