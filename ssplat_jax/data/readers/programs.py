"""Readers of cameras as programs export them: 3DGS, Polycam, Record3D, RealityScan and RealityCapture, Metashape."""

import csv
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation

from ssplat_jax.core.errors import AGAIN, reading, refusal
from ssplat_jax.data.images import FisheyeLens, Lens, image_size
from ssplat_jax.data.parsing import UNDISTORT, Fields, load_json, load_text, parse_numbers
from ssplat_jax.data.posed_image import Convention
from ssplat_jax.data.readers.frame_list import (
    SUFFIXES,
    FrameList,
    Intrinsics,
    Listing,
    Reader,
    files_with,
    find_file,
    images_folder,
    images_in,
    name_in,
    pinhole,
)

OPENGL = Convention(axes="opengl")

# -- cameras.json of 3DGS ---------------------------------------------------------------------------------------------
# A list of cameras beside a scene. Each has `img_name` (with or without extension), `width`, `height`, `fx` and `fy` in
# pixels, `position` (camera center) and `rotation` (camera-to-world, row by row, OpenCV axes). The principal point is
# the center of the image, or `cx` and `cy` where other programs write them. Images are in `images/` (or downscaled in
# `images_2`, `images_4`, `images_8`), else beside the file.

CAMERAS = "cameras.json"


def _is_list_of_cameras(path: Path) -> bool:
    file = path if path.name == CAMERAS else path / CAMERAS
    if not file.is_file():
        return False
    with file.open("rb") as opened:
        return opened.read(64).lstrip().startswith(b"[")


def _read_cameras_json(path: Path, convention: Convention) -> Listing:
    file = path if path.is_file() else path / CAMERAS
    frames, entries = FrameList(file.parent, convention, images_folder(file.parent)), load_json(file, list)
    for i, entry in enumerate(entries):
        fields = Fields(entry, where := f"{file}: [{i}]")
        name = fields.text("img_name")
        image = frames.named(name, f"{where}.img_name", ("", *SUFFIXES))
        matrix = np.column_stack([fields.numbers("rotation", (3, 3)), fields.numbers("position", (3,))])
        width, height = fields.number("width"), fields.number("height")
        cx, cy = fields.number("cx", width / 2), fields.number("cy", height / 2)
        intrinsics = Intrinsics(fx=fields.number("fx"), fy=fields.number("fy"), cx=cx, cy=cy)
        fields.refuse_lens("k1", "k2", "k3", "p1", "p2")
        frames.add(name, image, matrix, intrinsics, where, (width, height))
    return frames.listing(len(entries), "image")


SPLAT_CAMERAS = Reader(CAMERAS, _is_list_of_cameras, _read_cameras_json)

# -- Polycam ----------------------------------------------------------------------------------------------------------
# Raw data: in `keyframes/`, `images/1.jpg` and `cameras/1.json`, and optionally `depth/1.png`. Where Polycam has
# optimized the poses, `corrected_images` and `corrected_cameras` are read instead. `t_00` to `t_23` are the
# camera-to-world matrix row by row, in meters, with OpenGL axes in ARKit's world (+y up); `fx fy cx cy width height`
# are in pixels. Depth maps hold millimeters and have their own resolution.


def _keyframes(path: Path) -> Iterator[tuple[Path, str]]:
    """Folders of keyframes, and the prefix of the folders in them, "corrected_" or none."""
    for folder in (path / "keyframes", path):
        for prefix in ("corrected_", ""):
            if all((folder / f"{prefix}{kind}").is_dir() for kind in ("images", "cameras")):
                yield folder.resolve(), prefix


def _read_polycam(path: Path, convention: Convention) -> Listing:
    keyframes, prefix = next(_keyframes(path.resolve()))
    images, frames = images_in(keyframes / f"{prefix}images"), FrameList(path, convention)
    for image in images:
        file = find_file(keyframes, [f"{prefix}cameras/{image.stem}.json"], str(image))
        if file is not None:
            fields = Fields(load_json(file), str(file))
            matrix = [[fields.number(f"t_{i}{j}") for j in range(4)] for i in range(3)]
            fields.refuse_lens("k1", "k2", "k3", "p1", "p2", "distortion")
            fx, fy, cx, cy, width, height = map(fields.number, ("fx", "fy", "cx", "cy", "width", "height"))
            depth = None if prefix else find_file(keyframes, [f"depth/{image.stem}.png"], str(image))
            intrinsics = Intrinsics(fx=fx, fy=fy, cx=cx, cy=cy)
            frames.add(image.name, image, matrix, intrinsics, str(file), (width, height), key=image.stem, depth=depth)
    return frames.listing(len(images), "camera")


POLYCAM = Reader("Polycam", lambda path: any(True for _ in _keyframes(path)), _read_polycam, OPENGL)

# -- Record3D ---------------------------------------------------------------------------------------------------------
# `metadata.json` (or `metadata`) and the images `rgb/0.jpg` (or `rgbd/0.jpg`). `poses` holds a unit quaternion (xyzw)
# and a camera center per image, camera-to-world with OpenGL axes, in meters. `perFrameIntrinsicCoeffs`, where it is
# there, holds fx, fy, cx and cy per image, else `K` is the matrix of intrinsics of all images, column by column; both
# in pixels of an image of `w` x `h`. Depth maps are not read: they are floating-point EXR or compressed.

METADATA, RGB_FOLDERS = ("metadata.json", "metadata"), ("rgb", "rgbd")


def _is_record3d(path: Path) -> bool:
    return any((path / name).is_file() for name in METADATA) and any((path / name).is_dir() for name in RGB_FOLDERS)


def _read_record3d(path: Path, convention: Convention) -> Listing:
    """The images that exist; image `i.jpg` has pose `i`."""
    file = next(path / name for name in METADATA if (path / name).is_file())
    meta, frames = Fields(load_json(file), str(file)), FrameList(path, convention)
    poses = meta.entries("poses")
    if meta.get("perFrameIntrinsicCoeffs") is None:
        shared = pinhole(meta.numbers("K", (9,)).reshape(3, 3).T, f"{file}: K")
        intrinsics = [shared] * len(poses)
    else:
        intrinsics = [Intrinsics(*row) for row in meta.numbers("perFrameIntrinsicCoeffs", (len(poses), 4)).tolist()]
    described = (meta.number("w"), meta.number("h"))
    for i, (entry, intrinsic) in enumerate(zip(poses, intrinsics, strict=True)):
        where = f"{file}: poses[{i}]"
        names = [f"{folder}/{i}.{suffix}" for folder in RGB_FOLDERS for suffix in ("jpg", "png")]
        if (image := find_file(frames.root, names, where)) is not None:
            x, y, z, w, *center = Fields({"pose": entry}, where).numbers("pose", (7,))
            frames.add(name_in(frames.root, image), image, ((w, x, y, z), center), intrinsic, where, described)
    return frames.listing(len(poses), "image")


RECORD3D = Reader("Record3D", _is_record3d, _read_record3d, OPENGL)

# -- RealityScan and RealityCapture -----------------------------------------------------------------------------------
# A row of the CSV that "Internal/External camera parameters" exports holds `#name, x, y, alt, heading, pitch, roll, f,
# px, py, k1, k2, k3, k4, t1, t2`. Angles are in degrees: heading clockwise about the world's +z, then pitch, then roll,
# of a camera that looks along -z with +y up (OpenGL). `f`, `px` and `py` are in millimeters of a sensor whose longer
# side is 36 mm; the principal point is relative to the center. Images are in `images/`, else beside the file.

CSV_POSE = ("x", "y", "alt", "heading", "pitch", "roll", "f")
CSV_LENS = {"px": "px", "py": "py", "k1": "k1", "k2": "k2", "k3": "k3", "k4": "k4", "p1": "t1", "p2": "t2"}
SENSOR = 36.0  # millimeters of the longer side
CSV = (".csv", b"name", b"heading", b"pitch", b"roll")  # suffix, and names of columns with which a file begins


def _read_reality_capture(path: Path, convention: Convention) -> Listing:
    (file,) = files_with(path, *CSV)
    text = load_text(file)
    with reading(file):
        rows = list(csv.DictReader(text.lstrip("#").splitlines(), skipinitialspace=True))
    frames = FrameList(file.parent, convention, images_folder(file.parent))
    for i, row in enumerate(rows, start=2):
        where, name = f"{file}: line {i}", row.get("name") or ""
        if missing := [field for field in CSV_POSE if not row.get(field)]:
            raise refusal(where, wanted=", ".join(CSV_POSE), got=f"no {missing[0]}", fix=AGAIN)
        x, y, altitude, heading, pitch, roll, f = parse_numbers([row[field] for field in CSV_POSE], where)
        with reading(where):
            Fields({k: float(row.get(k) or 0) for k in ("k5", "k6", "skew")}, where).refuse_lens("k5", "k6", "skew")
        lens = dict(zip(CSV_LENS, parse_numbers([row.get(k) or "0" for k in CSV_LENS.values()], where), strict=True))
        if (image := frames.find(name, where, ("", *SUFFIXES))) is not None:
            width, height = image_size(image)
            unit = max(width, height) / SENSOR  # pixels per millimeter
            cx, cy = width / 2 + unit * lens.pop("px"), height / 2 + unit * lens.pop("py")
            matrix = np.eye(4)
            with reading(where):
                matrix[:3, :3] = Rotation.from_euler("ZXY", [-heading, pitch, roll], degrees=True).as_matrix()
            matrix[:3, 3] = x, y, altitude
            frames.add(name, image, matrix, Intrinsics(unit * f, unit * f, cx, cy, Lens(**lens)), where)
    return frames.listing(len(rows), "image")


REALITY_CAPTURE = Reader("RealityCapture", lambda path: len(files_with(path, *CSV)) == 1, _read_reality_capture, OPENGL)

# -- Metashape --------------------------------------------------------------------------------------------------------
# XML of cameras (File, Export, Export Cameras, Agisoft XML). A camera's `transform` is its 4x4 camera-to-chunk matrix
# row by row, with OpenCV axes. The transform of its component, or else of the chunk (rotation, translation, scale),
# leads to the world. A sensor's adjusted calibration has `f`, the principal point `cx`, `cy` relative to the center,
# `b1` = fx - fy, and `k1 k2 k3 k4 p1 p2`, where Metashape's p1 and p2 are the p2 and p1 of OpenCV. Images are found by
# the cameras' labels, in `images/`, else beside the file.

OFF = ("", "0", "false", "disabled")  # values of a switch
XML_LENS = {"k1": "k1", "k2": "k2", "k3": "k3", "k4": "k4", "p1": "p2", "p2": "p1"}
DOCUMENT = (".xml", b"<document", b"<chunk")  # suffix, and what a file of Metashape begins with


def _read_metashape(path: Path, convention: Convention) -> Listing:
    """The aligned cameras whose images exist."""
    (file,) = files_with(path, *DOCUMENT)
    text = load_text(file)
    if "<!DOCTYPE" in text or "<!ENTITY" in text:  # entities could grow without bound
        raise refusal(str(file), wanted="XML without definitions", got="a document type", fix=AGAIN)
    with reading(file):
        chunk, *others = ElementTree.fromstring(text).iter("chunk")
    sensors = {sensor.get("id"): sensor for sensor in chunk.iter("sensor")}
    worlds = {part.get("id"): part.find("transform") for part in chunk.iter("component")}
    frames = FrameList(file.parent, convention, images_folder(file.parent))
    listed = [camera for camera in chunk.iter("camera") if camera.get("label")]
    cameras = [camera for camera in listed if camera.get("enabled", "1") not in OFF]
    notes = [f"{len(others)} more chunks of {file.name} are left out: export each alone."] if others else []
    if len(cameras) < len(listed):
        notes.append(f"{len(listed) - len(cameras)} cameras are left out: they are disabled.")
    for camera in cameras:
        name = str(camera.get("label"))
        where, is_aligned = f"{file}: camera {name}", camera.find("transform") is not None
        if is_aligned and (image := frames.find(name, where, ("", *SUFFIXES))) is not None:
            pose = _xml_numbers(camera, "transform", where, np.eye(4))
            world = worlds.get(camera.get("component_id"))
            if (world := chunk.find("transform") if world is None else world) is not None:
                turn = _xml_numbers(world, "rotation", where, np.eye(3))
                shift = _xml_numbers(world, "translation", where, np.zeros(3))
                pose[:3, 3] = _xml_numbers(world, "scale", where, np.ones(1)) * turn @ pose[:3, 3] + shift
                pose[:3, :3] = turn @ pose[:3, :3]
            frames.add(name, image, pose, *_calibration(sensors.get(camera.get("sensor_id")), where))
    return frames.listing(len(cameras), "image or alignment", notes)


def _xml_numbers(element: ElementTree.Element, tag: str, where: str, default: np.ndarray) -> np.ndarray:
    """The numbers of a child of an element, in the shape of `default`, which counts where there is no such child."""
    text = element.findtext(tag)
    return default if text is None else np.reshape(parse_numbers(text.split(), where, default.size), default.shape)


def _calibration(sensor: ElementTree.Element | None, where: str) -> tuple[Intrinsics, str, tuple[float, float]]:
    """Intrinsics of a sensor, their location for messages, and the (width, height) that they are for."""
    calibrations = [] if sensor is None else sensor.findall("calibration")
    if not calibrations:
        raise refusal(where, wanted="a sensor with a calibration", got="none", fix="align the cameras, export again")
    calibration = next((c for c in calibrations if c.get("class") == "adjusted"), calibrations[0])
    kind, size = calibration.get("type", "frame"), calibration.find("resolution")
    if kind not in ("frame", "fisheye", "equidistant_fisheye"):
        raise refusal(where, wanted="a frame or fisheye sensor", got=kind, fix=UNDISTORT)
    with reading(where):
        texts = {value.tag: value.text or "" for value in calibration if value.tag not in ("resolution", "covariance")}
        texts |= {} if size is None else size.attrib
        values = Fields({name: float(text) for name, text in texts.items() if not text.isalpha()}, where)
    width, height = values.number("width"), values.number("height")
    lens = {ours: values.number(name, 0.0) for ours, name in XML_LENS.items()}
    values.refuse_lens("b2", "k5", "k6", "p3", "p4")  # b2 is skew
    cx, cy = width / 2 + values.number("cx", 0.0), height / 2 + values.number("cy", 0.0)
    f, model = values.number("f"), Lens if kind == "frame" else FisheyeLens
    return Intrinsics(f + values.number("b1", 0.0), f, cx, cy, model(**lens)), where, (width, height)


METASHAPE = Reader("Metashape", lambda path: len(files_with(path, *DOCUMENT)) == 1, _read_metashape)
