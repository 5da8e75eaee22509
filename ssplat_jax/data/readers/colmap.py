"""Reader of COLMAP reconstructions: `sparse/0/`, `sparse/` or `colmap/sparse/0/` with `cameras` and `images`.

Where there is no `sparse/0`, the reconstruction of the lowest number is read; a note names a larger one beside it.

Poses are world-to-camera with OpenCV axes, in COLMAP's world; pixel centers are at +0.5. Images are in `images/` (or
downscaled in `images_2`, `images_4`, `images_8`), else in the folder of the capture. Images that COLMAP did not
register, and registered ones whose file is missing, are left out and counted. Perspective and fish-eye camera models
are supported (`MODELS`); cameras that no image uses may be of any model. If there are binary and text files, the binary
ones are read. Format: colmap.github.io/format.html.

The parser is our own, because a bare install must read what most captures come with.
"""

import contextlib
import io
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from ssplat_jax.core.errors import InputError, echo, reading, refusal
from ssplat_jax.data.images import FisheyeLens, Lens
from ssplat_jax.data.parsing import UNDISTORT, load_lines, parse_numbers
from ssplat_jax.data.posed_image import Convention
from ssplat_jax.data.readers.frame_list import FrameList, Intrinsics, Listing, Reader, images_folder, images_in

FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", ".")  # places of a reconstruction, in the order of search
MODELS = (  # name, parameters, and whether the camera is supported, by id
    ("SIMPLE_PINHOLE", "f cx cy", True),
    ("PINHOLE", "fx fy cx cy", True),
    ("SIMPLE_RADIAL", "f cx cy k1", True),
    ("RADIAL", "f cx cy k1 k2", True),
    ("OPENCV", "fx fy cx cy k1 k2 p1 p2", True),
    ("OPENCV_FISHEYE", "fx fy cx cy k1 k2 k3 k4", True),
    ("FULL_OPENCV", "fx fy cx cy k1 k2 p1 p2 k3 d1 d2 d3", True),
    ("FOV", "fx fy cx cy omega", False),
    ("SIMPLE_RADIAL_FISHEYE", "f cx cy k1", True),
    ("RADIAL_FISHEYE", "f cx cy k1 k2", True),
    ("THIN_PRISM_FISHEYE", "fx fy cx cy k1 k2 p1 p2 k3 k4 sx1 sy1", False),
    ("RAD_TAN_THIN_PRISM_FISHEYE", "fx fy cx cy k0 k1 k2 k3 k4 k5 p0 p1 s0 s1 s2 s3", False),
    ("SIMPLE_DIVISION", "f cx cy k", False),
    ("DIVISION", "fx fy cx cy k", False),
    ("SIMPLE_FISHEYE", "f cx cy", True),
    ("FISHEYE", "fx fy cx cy", True),
    ("EUCM", "fx fy cx cy alpha beta", False),
    ("EQUIRECTANGULAR", "w h", False),
)
COPY_AGAIN = "copy the reconstruction again"


class ImageEntry(NamedTuple):
    """Registered image, with its location in the file for messages."""

    name: str
    pose: list[float]  # world-to-camera: quaternion wxyz, translation
    camera: int  # id
    where: str


class CameraEntry(NamedTuple):
    """Camera as its file gives it, with its location for messages; images that use it need a supported model."""

    model: str
    size: tuple[float, float]  # (width, height) of the images that COLMAP used
    params: list[float]
    where: str


def _read(path: Path, convention: Convention) -> Listing:
    """The registered images whose files exist."""
    model, root = next(_models(path)), path.resolve()
    cameras, entries = _load(model)
    folder = images_folder(root)
    if folder and all(entry.name.startswith(folder) for entry in entries):
        folder = ""  # COLMAP ran on the parent folder, so the names include images/
    frames = FrameList(root, convention, folder)
    for entry in entries:
        if (image := frames.find(entry.name, entry.where)) is not None:
            if entry.camera not in cameras:
                got = f"camera {entry.camera}, which is missing"
                raise refusal(entry.where, wanted="a camera of the reconstruction", got=got, fix=COPY_AGAIN)
            camera, where = cameras[entry.camera], f"{entry.where}, camera {entry.camera}"
            frames.add(entry.name, image, (entry.pose[:4], entry.pose[4:]), _intrinsics(camera), where, camera.size)
    notes = _larger_models(path, model, len(entries))
    inside = {image.resolve() for image in images_in(root / "images", "**/*")}
    if (others := inside - {frame.path for frame in frames.frames}) and len(others) < len(inside):
        notes = [f"{len(others)} images in images/ are left out: COLMAP did not register them.", *notes]
    return frames.listing(len(entries), "file", notes)


def _models(path: Path) -> Iterator[Path]:
    """Folders of reconstructions, in the order of search: the usual ones, then the others by their number."""
    yield from (path / folder for folder in FOLDERS if _is_model(path / folder))
    for base in (path / "sparse", path / "colmap" / "sparse"):
        yield from sorted(_numbered(base), key=lambda folder: int(folder.name))


def _numbered(base: Path) -> list[Path]:
    """Reconstructions in the folder `base` whose names are numbers."""
    return [folder for folder in base.glob("[0-9]*") if folder.name.isdecimal() and _is_model(folder)]


def _is_model(folder: Path) -> bool:
    """True if a folder holds a reconstruction."""
    return any((folder / f"images.{kind}").is_file() for kind in ("bin", "txt"))


def _larger_models(path: Path, model: Path, num_images: int) -> list[str]:
    """A note about the reconstruction beside `model` with the most images, if it has more than `num_images`."""
    counts = {model: num_images}
    for folder in _numbered(model.parent) if model != path and model.name.isdecimal() else ():
        with contextlib.suppress(InputError):  # a damaged reconstruction that is not read
            counts.setdefault(folder, len(_load(folder)[1]))
    largest = max(counts, key=lambda folder: counts[folder])
    if largest == model:
        return []
    found = f"{largest.relative_to(path)} holds {counts[largest]} images; {model.relative_to(path)}, which is read,"
    return [f"{found} holds {num_images}. Swap the folders' names to read the larger one."]


def _intrinsics(camera: CameraEntry) -> Intrinsics:
    """Intrinsics of a camera that an image uses; unsupported models are refused."""
    supported = {name: params.split() for name, params, is_supported in MODELS if is_supported}
    names = supported.get(camera.model)
    if names is None:
        wanted = f"one of {', '.join(supported)}"
        raise refusal(camera.where, wanted=wanted, got=echo(camera.model), fix=UNDISTORT)
    if len(camera.params) != len(names):
        wanted = f"{len(names)} parameters ({' '.join(names)})"
        raise refusal(camera.where, wanted=wanted, got=str(len(camera.params)), fix=COPY_AGAIN)
    fields: dict[str, Any] = dict(zip(names, camera.params, strict=True))
    focal = fields.pop("f", None)
    fx, fy, cx, cy = (fields.pop(name, focal) for name in ("fx", "fy", "cx", "cy"))
    lens = FisheyeLens(**fields) if "FISHEYE" in camera.model else Lens(**fields)
    return Intrinsics(fx=fx, fy=fy, cx=cx, cy=cy, lens=lens)


# -- files ------------------------------------------------------------------------------------------------------------


def _load(model: Path) -> tuple[dict[int, CameraEntry], list[ImageEntry]]:
    """Cameras by id and registered images of the reconstruction in a folder."""
    if (model / "images.bin").is_file():
        return _binary_cameras(model / "cameras.bin"), _binary_images(model / "images.bin")
    return _text_cameras(model / "cameras.txt"), _text_images(model / "images.txt")


def _take(file: io.BytesIO, layout: str) -> tuple:
    """The next little-endian values of a `struct` layout, which raises at the end of the file."""
    return struct.unpack("<" + layout, file.read(struct.calcsize("<" + layout)))


def _binary_cameras(path: Path) -> dict[int, CameraEntry]:
    """Cameras of cameras.bin by id."""
    cameras = {}
    with reading(path, COPY_AGAIN):
        file = io.BytesIO(path.read_bytes())
        for _ in range(*_take(file, "Q")):
            camera, model, width, height = _take(file, "IiQQ")
            where = f"{path}: camera {camera}"
            if not 0 <= model < len(MODELS):  # the number of its parameters is unknown, so the rest cannot be read
                known = ", ".join(name for name, _, _ in MODELS)
                raise refusal(where, wanted=f"one of {known}", got=f"'model {model}'", fix=UNDISTORT)
            name, params, _ = MODELS[model]
            values = list(_take(file, f"{len(params.split())}d"))
            cameras[camera] = CameraEntry(name, (float(width), float(height)), values, where)
    return cameras


def _binary_images(path: Path) -> list[ImageEntry]:
    """Images of images.bin; their 2D points are skipped."""
    images = []
    with reading(path, COPY_AGAIN):
        file = io.BytesIO(data := path.read_bytes())
        for _ in range(*_take(file, "Q")):
            image, *pose, camera = _take(file, "I7dI")
            name = file.read(data.index(b"\0", file.tell()) + 1 - file.tell())[:-1].decode()
            images.append(ImageEntry(name, pose, camera, f"{path}: image {image}"))
            file.seek(struct.calcsize("<ddq") * _take(file, "Q")[0], io.SEEK_CUR)
        if file.tell() > len(data):
            raise ValueError("it is cut off")
    return images


def _text_cameras(path: Path) -> dict[int, CameraEntry]:
    """Cameras of cameras.txt by id."""
    cameras = {}
    for where, line in load_lines(path):
        if line:
            with reading(where, COPY_AGAIN):
                camera, model, width, height, *params = line.split()
                size = (float(int(width)), float(int(height)))
                cameras[int(camera)] = CameraEntry(model, size, parse_numbers(params, where), where)
    return cameras


def _text_images(path: Path) -> list[ImageEntry]:
    """Images of images.txt, two lines each: pose and name, and the 2D points (this line may be empty)."""
    images, lines = [], iter(load_lines(path))
    for where, line in lines:
        if line:
            with reading(where, COPY_AGAIN):
                _, *words, camera, name = line.split(maxsplit=9)
                images.append(ImageEntry(name, parse_numbers(words, where, 7), int(camera), where))
            points = next(lines, ("", ""))[1].split()
            if len(points) % 3 or (points and not points[-1].lstrip("-").isdigit()):
                raise refusal(where, wanted="a line of 2D points below", got="another line", fix=COPY_AGAIN)
    return images


COLMAP = Reader("COLMAP", lambda path: any(True for _ in _models(path)), _read, Convention(poses="world-to-camera"))
