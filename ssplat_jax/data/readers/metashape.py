"""Reader of the XML of cameras that Metashape exports (File, Export, Export Cameras, Agisoft XML), and the images.

A camera's `transform` is its 4x4 camera-to-chunk matrix row by row, with OpenCV axes. The transform of its component,
or else of the chunk (rotation, translation, scale), leads to the world. A sensor's adjusted calibration has `f`, the
principal point `cx`, `cy` relative to the center, `b1` = fx - fy, and `k1 k2 k3 k4 p1 p2`, where Metashape's p1 and p2
are the p2 and p1 of OpenCV. Images are found by the cameras' labels, in `images/`, else beside the file.
"""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from ssplat_jax.core.errors import refusal
from ssplat_jax.data.images import FisheyeLens, Lens
from ssplat_jax.data.parsing import AGAIN, Fields, load_text, parse_numbers, reading
from ssplat_jax.data.posed_image import check_camtoworld
from ssplat_jax.data.readers.frame_list import (
    CUT,
    SUFFIXES,
    UNDISTORT,
    FrameList,
    Intrinsics,
    Listing,
    file_named,
    files_with,
    images_folder,
    stored_size,
)

FORMAT = "Metashape"
OFF = ("", "0", "false", "disabled")  # values of a switch
LENS = {"k1": "k1", "k2": "k2", "k3": "k3", "k4": "k4", "p1": "p2", "p2": "p1"}


def matches(path: Path) -> bool:
    """True if `path` is an XML file of cameras, or a folder that holds exactly one."""
    return len(_documents(path)) == 1


def read(path: Path) -> Listing:
    """Reads the aligned cameras whose images exist."""
    (file,) = _documents(path)
    root, text = file.parent.resolve(), load_text(file)
    if "<!DOCTYPE" in text or "<!ENTITY" in text:  # entities could grow without bound
        raise refusal(str(file), wanted="XML without definitions", got="a document type", fix=AGAIN)
    with reading(file):
        chunk, *others = ElementTree.fromstring(text).iter("chunk")
    sensors = {sensor.get("id"): sensor for sensor in chunk.iter("sensor")}
    worlds = {part.get("id"): part.find("transform") for part in chunk.iter("component")}
    frames, folder = FrameList(root), images_folder(root)
    listed = [camera for camera in chunk.iter("camera") if camera.get("label")]
    cameras = [(camera, str(camera.get("label"))) for camera in listed if camera.get("enabled", "1") not in OFF]
    notes = [f"{len(others)} more chunks of {file.name} are left out: export each alone."] if others else []
    if len(cameras) < len(listed):
        notes.append(f"{len(listed) - len(cameras)} cameras are left out: they are disabled.")
    if any((shutter.text or "").strip() not in OFF for shutter in chunk.iter("rolling_shutter")):
        notes.append("The rolling shutter is not modelled: every image has one pose.")
    for camera, name in cameras:
        where, matrix = f"{file}: camera {name}", camera.find("transform")
        image = None if matrix is None else frames.find(folder + name, where, ("", *SUFFIXES))
        if image is not None:
            pose = np.reshape(_numbers(camera, "transform", where, np.eye(4)), (4, 4))
            world = worlds.get(camera.get("component_id"))
            if (world := chunk.find("transform") if world is None else world) is not None:
                turn = _numbers(world, "rotation", where, np.eye(3))
                shift = _numbers(world, "translation", where, np.zeros(3))
                pose[:3, 3] = _numbers(world, "scale", where, np.ones(1)) * turn @ pose[:3, 3] + shift
                pose[:3, :3] = turn @ pose[:3, :3]
            intrinsics, size = _intrinsics(sensors.get(camera.get("sensor_id")), where)
            frames.add(name, image, check_camtoworld(pose, where), intrinsics, stored_size(image, size, where), where)
    if cameras and not frames.frames:
        file_named(root, folder + cameras[0][1], f"{file}: camera {cameras[0][1]}")  # refuses it
    return frames.listing(len(cameras), "image or alignment", notes)


def _numbers(element: ElementTree.Element, tag: str, where: str, default: np.ndarray) -> np.ndarray:
    """The numbers of a child of an element, in the shape of `default`, which counts where there is no such child."""
    text = element.findtext(tag)
    return default if text is None else np.reshape(parse_numbers(text.split(), where, default.size), default.shape)


def _intrinsics(sensor: ElementTree.Element | None, where: str) -> tuple[Intrinsics, tuple[float, float]]:
    """Intrinsics of a sensor, and the (width, height) that they are for."""
    calibrations = [] if sensor is None else sensor.findall("calibration")
    if not calibrations:
        raise refusal(where, wanted="a sensor with a calibration", got="none", fix="align the cameras, export again")
    calibration = next((c for c in calibrations if c.get("class") == "adjusted"), calibrations[0])
    kind, size = calibration.get("type", "frame"), calibration.find("resolution")
    if kind not in ("frame", "fisheye", "equidistant_fisheye"):
        raise refusal(where, wanted="a frame or fisheye sensor", got=kind, fix=CUT if "spher" in kind else UNDISTORT)
    with reading(where):
        texts = {value.tag: value.text or "" for value in calibration if value.tag not in ("resolution", "covariance")}
        texts |= {} if size is None else size.attrib
        values = Fields({name: float(text) for name, text in texts.items() if not text.isalpha()}, where)
    width, height = values.number("width"), values.number("height")
    lens = {ours: values.number(name, 0.0) for ours, name in LENS.items()}
    values.refuse("b2", "k5", "k6", "p3", "p4", fix=UNDISTORT)  # b2 is skew
    if kind != "frame" and (lens["p1"] or lens["p2"]):
        got = "a fish-eye lens with p1 or p2"
        raise refusal(where, wanted="p1 and p2 for frame cameras alone", got=got, fix=UNDISTORT)
    cx, cy = width / 2 + values.number("cx", 0.0), height / 2 + values.number("cy", 0.0)
    f, model = values.number("f"), Lens if kind == "frame" else FisheyeLens
    return Intrinsics(f + values.number("b1", 0.0), f, cx, cy, model(**lens)), (width, height)


def _documents(path: Path) -> list[Path]:
    """The file at `path`, or those in the folder `path`, that begin as Metashape's do."""
    return files_with(path, ".xml", b"<document", b"<chunk")
