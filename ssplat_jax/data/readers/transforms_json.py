"""Reader of `transforms.json` of nerfstudio, instant-ngp and Blender.

Poses are camera-to-world with OpenGL axes (+x right, +y up, +z backward) and are converted to OpenCV axes. They are not
re-centered or rescaled, and `applied_transform` is ignored, so results are in the frame of the file.
Intrinsics are global or per frame, and a frame's own value comes first: fl_x, fl_y, cx, cy, w, h in pixels of the
stored image, or camera_angle_x in radians. Defaults are fl_y = fl_x, the center of the image, and the size of the
image file. Distortion (k1 to k4, p1, p2) follows the Brown-Conrady model, or with `camera_model` OPENCV_FISHEYE or
`is_fisheye` the fish-eye model (k1 to k4), and is removed when images are delivered; `distortion_params` is the list
k1 k2 k3 k4 p1 p2, and with FULL_OPENCV k4 to k6 are the denominator. Depth maps (`depth_file_path`, `depth_path`)
count steps of `integer_depth_scale`, else millimeters times `applied_scale`. Frames with `is_bad` (ScanNet++) are left
out. Without a transforms.json, the split transforms_train.json is read.
DL3DV keeps the file and its images in a folder `nerfstudio`, which is opened with the folder around it.
"""

import math
from pathlib import Path
from typing import Any

from ssplat_jax.core.errors import InputError, echo, refusal
from ssplat_jax.data.images import FisheyeLens, Lens, image_size
from ssplat_jax.data.parsing import UNDISTORT, Fields, load_json
from ssplat_jax.data.posed_image import MILLIMETER, Convention
from ssplat_jax.data.readers.frame_list import SUFFIXES, FrameList, Intrinsics, Listing, Reader, in_images, stored_size
from ssplat_jax.data.readers.programs import SPLAT_CAMERAS

PLACES = ("transforms.json", "nerfstudio/transforms.json", "transforms_train.json")
PINHOLE_MODELS = (None, "OPENCV", "FULL_OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
FISHEYE_MODELS = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2")  # in the order of `distortion_params`
UNKNOWN_LENS = ("k5", "k6", "s1", "s2", "s3", "s4", "xi", "omega", "skew", "orthographic", "equirectangular", "latlong")
UNKNOWN_LENS += tuple(f"ftheta_p{i}" for i in range(5))  # as the three before, of instant-ngp
UNKNOWN_UNITS = ("depth_scale", "depth_factor", "depth_unit")  # some multiply by these and others divide


def _matches(path: Path) -> bool:
    if path.is_file():
        return path.suffix == ".json" and not SPLAT_CAMERAS.matches(path)
    return any((path / name).is_file() for name in PLACES)


def num_listed(path: Path) -> int:
    """Number of frames that the file lists, readable or not; 0 while the file itself cannot be read."""
    try:
        return len(Fields(load_json(_file(path)), "").entries("frames"))
    except InputError:
        return 0


def _file(path: Path) -> Path:
    """The file at `path` or in the folder `path`."""
    if path.is_file():
        return path
    return next((path / name for name in PLACES if (path / name).is_file()), path / PLACES[0])


def read_transforms(path: Path, convention: Convention, problems: list[str] | None = None) -> Listing:
    """The frames of a capture in the folder `path`, or of the file `path`.

    With `problems`, those before the first that cannot be read, of a capture that is still being written; the reason
    why it cannot be read is added to that list.

    Raises:
        InputError: the file cannot be read, or a frame of it; with `problems`, no frame of it.
    """
    file = _file(path)
    meta = load_json(file)
    entries = Fields(meta, str(file)).entries("frames")
    frames, num_bad = FrameList(file.parent, convention), 0
    for i, entry in enumerate(entries):
        if isinstance(entry, dict) and entry.get("is_bad") is True:
            num_bad += 1
            continue
        try:
            _add_frame(frames, meta, entry, f"{file}: frames[{i}]")
        except InputError as error:
            if problems is None or not frames.frames:
                raise
            problems.append(str(error))
            break
    notes = [f"{num_bad} frames are left out, because the file calls them bad (is_bad)."] if num_bad else []
    if file.name == PLACES[-1]:
        notes.append(f"There is no {PLACES[0]}: {file.name} is read, and the images of other splits are left out.")
    return frames.listing(len(frames.frames), "image", notes)


def _add_frame(frames: FrameList, meta: dict[str, Any], entry: Any, where: str) -> None:
    """Adds one entry of the list `frames`, whose own values come before the global ones of `meta`."""
    own = Fields(entry, where)
    fields = Fields(meta | entry, where)
    name = own.get("file_path")
    image = frames.named(name, f"{where}.file_path", ("", *SUFFIXES))
    depth_kind = "depth_path" if own.get("depth_file_path") is None else "depth_file_path"
    depth, mask = (
        None if own.get(kind) is None else frames.file_named(own.get(kind), f"{where}.{kind}")
        for kind in (depth_kind, "mask_path")
    )
    is_shrunk = in_images(str(name)) is not None and not (frames.root / "images").is_dir()
    has_size = fields.get("w") is not None and fields.get("h") is not None
    if is_shrunk and not has_size and any(fields.get(field) is not None for field in ("fl_x", "fl_y", "cx", "cy")):
        got = f"none, and {image.parent.name}/{image.name} in its place"
        fix = "add w and h, so that the intrinsics can be shrunk too"
        raise refusal(f"{where}: w, h", wanted="the size of the image that is described", got=got, fix=fix)
    stored = [0.0, 0.0] if has_size else [float(side) for side in image_size(image)]
    described = (fields.number("w", stored[0]), fields.number("h", stored[1]))
    (width, height), shrink = stored_size(image, described, f"{where}: w, h")
    fx, fy = _focal(fields, own, width / shrink, height / shrink)
    cx, cy = (fields.number(field, side / shrink / 2) for field, side in (("cx", width), ("cy", height)))
    intrinsics = Intrinsics(fx=fx, fy=fy, cx=cx, cy=cy, lens=_lens(fields, own))
    frames.add(str(name), image, own.get("transform_matrix"), intrinsics, where, described,
               pose_field=".transform_matrix", depth=depth, depth_unit=_depth_unit(fields), mask=mask)  # fmt: skip


def _depth_unit(fields: Fields) -> float:
    """Capture units per step of a depth map; fields whose meaning differs from tool to tool are refused."""
    has_depth = fields.get("depth_file_path") is not None or fields.get("depth_path") is not None
    for name in UNKNOWN_UNITS:
        if has_depth and fields.get(name) is not None:
            fix = "write integer_depth_scale, the capture units in a step of the depth maps, instead"
            raise refusal(f"{fields.where}.{name}", wanted="integer_depth_scale", got=echo(fields.get(name)), fix=fix)
    return fields.number("integer_depth_scale", MILLIMETER * fields.number("applied_scale", 1.0))


def _lens(fields: Fields, own: Fields) -> Lens:
    """Distortion by the camera's model; models without one of OpenCV's two lenses are refused.

    A list of the file gives way to coefficients that the frame has of its own.
    """
    model, flag = fields.get("camera_model"), fields.get("is_fisheye")
    if flag not in (None, True, False):
        raise refusal(f"{fields.where}.is_fisheye", wanted="true or false", got=echo(flag), fix="write a JSON boolean")
    is_fisheye = model in FISHEYE_MODELS or bool(flag)
    if not is_fisheye and model not in PINHOLE_MODELS:
        wanted = "OPENCV, PINHOLE or OPENCV_FISHEYE"
        raise refusal(f"{fields.where}: camera_model", wanted=wanted, got=echo(model), fix=UNDISTORT)
    has_own = own.get("distortion_params") is None and any(own.get(name) is not None for name in COEFFICIENTS)
    if has_own or fields.get("distortion_params") is None:
        coefficients = {name: fields.number(name, 0.0) for name in COEFFICIENTS}
    else:
        coefficients = dict(zip(COEFFICIENTS, fields.numbers("distortion_params", (6,)).tolist(), strict=True))
    if model == "FULL_OPENCV":
        coefficients |= {"d1": coefficients.pop("k4"), "d2": fields.number("k5", 0.0), "d3": fields.number("k6", 0.0)}
    fields.refuse_lens(*UNKNOWN_LENS[2 * (model == "FULL_OPENCV") :])
    return FisheyeLens(**coefficients) if is_fisheye else Lens(**coefficients)


def _focal(fields: Fields, own: Fields, width: float, height: float) -> tuple[float, float]:
    """Focal lengths in pixels, from fl_x and fl_y or the fields of view camera_angle_x and camera_angle_y."""
    # If the frame's own fields are angles alone, a focal length of the file is of another camera.
    is_own = {kind: any(own.get(f"{kind}_{axis}") is not None for axis in "xy") for kind in ("fl", "camera_angle")}
    sources = (own,) if is_own["camera_angle"] and not is_own["fl"] else (own, fields)
    focals = {}
    for axis, extent in (("x", width), ("y", height)):
        kinds = [(kind, source) for source in sources for kind in ("fl", "camera_angle")]
        found = next(((k, s) for k, s in kinds if s.get(f"{k}_{axis}") is not None), None)
        if found is not None:
            kind, source = found
            value = source.number(f"{kind}_{axis}")
            if kind == "camera_angle":
                if not (0 < value < math.pi and math.tan(value / 2) > 0):
                    where = f"{fields.where}.camera_angle_{axis}"
                    raise refusal(where, wanted="an angle in (0, pi)", got=echo(value), fix="give it in radians")
                value = extent / (2 * math.tan(value / 2))
            focals[axis] = value
    if not focals:
        fix = "give fl_x in pixels or camera_angle_x in radians"
        raise refusal(f"{fields.where}.fl_x", wanted="a focal length", got="nothing", fix=fix)
    return focals.get("x", focals.get("y", 0.0)), focals.get("y", focals.get("x", 0.0))


TRANSFORMS_JSON = Reader("transforms.json", _matches, read_transforms, Convention(axes="opengl"))
