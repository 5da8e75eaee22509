"""Reader of COLMAP reconstructions: `sparse/0/`, `sparse/` or `colmap/sparse/0/` with `cameras` and `images`.

Where there is no `sparse/0`, the reconstruction of the lowest number is read; a note names a larger one beside it.

Poses are world-to-camera with OpenCV axes, in COLMAP's world; pixel centers are at +0.5. Images are in `images/` (or
downscaled in `images_2`, `images_4`, `images_8`), else in the folder of the capture. Images that COLMAP did not
register, and registered ones whose file is missing, are left out and counted. Perspective and fish-eye camera models
are supported (`MODELS`), FULL_OPENCV only without its denominator (k4 to k6); cameras that no image uses may be of any
model. If there are binary and text files, the binary ones are read. Format: colmap.github.io/format.html.
"""

import struct
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from ssplat_jax.core.errors import InputError, echo, refusal
from ssplat_jax.data.lens import FisheyeLens, Lens
from ssplat_jax.data.pose_conventions import Convention
from ssplat_jax.data.posed_image import Frame, pose_from_quat
from ssplat_jax.data.readers import Listing
from ssplat_jax.data.readers.frame_list import (
    EXTENSIONS,
    SHRUNK_FOLDERS,
    Intrinsics,
    file_named,
    find_named,
    list_frames,
    make_frame,
    stored_size,
)
from ssplat_jax.data.readers.strict_text import load_lines, parse_numbers

FORMAT = "COLMAP"
CONVENTION = Convention(poses="world-to-camera")
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
UNDISTORT = "undistort the images to pinhole cameras first (`colmap image_undistorter`)"
COPY_AGAIN = "copy the reconstruction again"
CAMERA_BYTES = 24  # id, model, width and height of a camera
IMAGE_BYTES = 73  # id, pose, camera, empty name and number of points of an image, at least
POINT_BYTES = 24  # x, y and 3D point of a 2D point


class ImageEntry(NamedTuple):
    """Registered image."""

    name: str
    quat: tuple[float, ...]  # world-to-camera, wxyz
    translation: tuple[float, ...]
    camera: int  # id
    where: str  # location in the file for error messages


class CameraEntry(NamedTuple):
    """Camera as its file gives it; images that use it need a supported model."""

    model: str
    size: tuple[float, float]  # (width, height) of the images that COLMAP used
    params: tuple[float, ...]
    where: str  # location in the file for error messages


def matches(path: Path) -> bool:
    """True if `path` is a folder with a reconstruction."""
    return _model_folder(path) is not None


def read(path: Path) -> Listing:
    """Reads the registered images of the reconstruction in the folder `path`."""
    model, root = _model_folder(path), path.resolve()
    assert model is not None  # `matches` is true
    cameras, entries = _cameras(model), _images(model)
    if not entries:
        fix = "run the reconstruction again: no image was registered"
        raise refusal(str(model), wanted="registered images", got="none", fix=fix)
    folder = "images/" if any((root / name).is_dir() for name in ("images", *SHRUNK_FOLDERS)) else ""
    if folder and all(entry.name.startswith(folder) for entry in entries):
        folder = ""  # COLMAP ran on the parent folder, so the names include images/
    seen: dict[Path | None, str] = {}
    frames, num_registered = [], len(entries)
    for entry in entries:
        path_of_image = find_named(root, folder + entry.name, entry.where, folders=SHRUNK_FOLDERS)
        if path_of_image is None:
            continue
        frame = _frame(path_of_image, entry, cameras)
        if seen.setdefault(frame.path, entry.where) is not entry.where:
            got = f"{echo(entry.name)} twice"
            raise refusal(entry.where, wanted="every image once", got=got, fix="remove one of the two")
        frames.append(frame)
    if not frames:
        file_named(root, folder + entries[0].name, entries[0].where, folders=SHRUNK_FOLDERS)  # refuses it
    num_missing, num_unposed = num_registered - len(frames), _num_others(root / "images", seen)
    missing = f"{num_missing} of {num_registered} registered images are skipped: their files are missing."
    unposed = f"{num_unposed} images in images/ are left out: COLMAP did not register them."
    notes = [note for note, number in ((missing, num_missing), (unposed, num_unposed)) if number]
    return list_frames(root.name, frames, [*notes, *_larger_models(path, model, num_registered)])


def _cameras(model: Path) -> dict[int, CameraEntry]:
    """Cameras by id of the reconstruction in a folder."""
    if (model / "images.bin").is_file():
        return _binary_cameras(model / "cameras.bin")
    return _text_cameras(model / "cameras.txt")


def _images(model: Path) -> list[ImageEntry]:
    """Registered images of the reconstruction in a folder."""
    if (model / "images.bin").is_file():
        return list(_binary_images(model / "images.bin"))
    return list(_text_images(model / "images.txt"))


def _num_images(model: Path) -> int:
    """Number of registered images of the reconstruction in a folder."""
    file = model / "images.bin"
    return _Binary(file).count(IMAGE_BYTES) if file.is_file() else len(_images(model))


def _num_others(images: Path, seen: Collection[Path | None]) -> int:
    """Number of the image files in the folder `images` that are not in `seen`; 0 if none of those is in the folder."""
    suffixes = {extension.lower() for extension in EXTENSIONS if extension}
    if not any(path is not None and path.is_relative_to(images) for path in seen):
        return 0
    files = {file.resolve() for file in images.rglob("*") if file.suffix.lower() in suffixes and file.is_file()}
    return len(files - set(seen))


def _larger_models(path: Path, model: Path, num_registered: int) -> list[str]:
    """A note about the reconstruction beside `model` with the most images, if it has more than `num_registered`."""
    if model == path or not model.name.isdecimal():
        return []
    counts = {}
    for folder in model.parent.glob("[0-9]*"):
        if folder != model and folder.name.isdecimal() and _is_model(folder):
            try:
                counts[folder] = _num_images(folder)
            except InputError:  # a damaged reconstruction that is not read
                continue
    largest = max(counts, key=lambda folder: counts[folder], default=None)
    if largest is None or counts[largest] <= num_registered:
        return []
    other, read = (folder.relative_to(path) for folder in (largest, model))
    found = f"{other} holds {counts[largest]} images; {read}, which is read, holds {num_registered}"
    return [f"{found}. Swap the folders' names to read the larger one."]


def _model_folder(path: Path) -> Path | None:
    """Folder of the reconstruction, or None."""
    for folder in FOLDERS:
        if _is_model(path / folder):
            return path / folder
    for base in (path / "sparse", path / "colmap" / "sparse"):
        numbers = sorted(int(file.name) for file in base.glob("[0-9]*") if file.name.isdecimal())
        for number in numbers:
            if _is_model(base / str(number)):
                return base / str(number)
    return None


def _is_model(folder: Path) -> bool:
    """True if a folder holds a reconstruction."""
    return any((folder / f"images.{kind}").is_file() for kind in ("bin", "txt"))


def _frame(path: Path, entry: ImageEntry, cameras: dict[int, CameraEntry]) -> Frame:
    """Checked frame of a registered image, whose file is `path`."""
    if entry.camera not in cameras:
        got = f"camera {entry.camera}, which is missing"
        raise refusal(entry.where, wanted="a camera of the reconstruction", got=got, fix=COPY_AGAIN)
    camera = cameras[entry.camera]
    fix = "use the images that COLMAP used"
    size, shrink = stored_size(path, camera.size, entry.where, fix)
    return make_frame(
        entry.name,
        path,
        CONVENTION.to_opencv(pose_from_quat(entry.quat, entry.translation, entry.where)),
        _intrinsics(camera),
        size,
        f"{entry.where}, camera {entry.camera}",
        shrink=shrink,
    )


def _intrinsics(camera: CameraEntry) -> Intrinsics:
    """Intrinsics of a camera that an image uses; unsupported models are refused."""
    names = next((params for name, params, supported in MODELS if name == camera.model and supported), None)
    if names is None:
        supported = ", ".join(name for name, _, supported in MODELS if supported)
        raise refusal(camera.where, wanted=f"one of {supported}", got=echo(camera.model), fix=UNDISTORT)
    if len(camera.params) != len(names.split()):
        got = str(len(camera.params))
        wanted = f"{len(names.split())} parameters ({names})"
        raise refusal(camera.where, wanted=wanted, got=got, fix=COPY_AGAIN)
    fields: dict[str, Any] = dict(zip(names.split(), camera.params, strict=True))
    if any(fields.pop(name, 0.0) != 0.0 for name in ("d1", "d2", "d3")):
        raise refusal(camera.where, wanted="FULL_OPENCV with k4 = k5 = k6 = 0", got="a denominator", fix=UNDISTORT)
    focal = fields.pop("f", None)
    fx, fy = (fields.pop("fx", focal), fields.pop("fy", focal))
    cx, cy = fields.pop("cx"), fields.pop("cy")
    lens = FisheyeLens(**fields) if "FISHEYE" in camera.model else Lens(**fields)
    return Intrinsics(fx=fx, fy=fy, cx=cx, cy=cy, lens=lens)


class _Binary:
    """Sequential reader of little-endian values; reading past the end of the file is refused."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._data = memoryview(path.read_bytes())
        except OSError as error:
            raise refusal(str(path), wanted="a readable file", got=error.strerror, fix=COPY_AGAIN) from None
        self._at = 0

    def take(self, layout: str) -> tuple:
        """Returns the values of a `struct` layout."""
        layout = "<" + layout
        return struct.unpack(layout, self._bytes(struct.calcsize(layout)))

    def skip(self, num_bytes: int) -> None:
        """Skips `num_bytes`."""
        self._bytes(num_bytes)

    def count(self, min_bytes: int) -> int:
        """Returns a number of entries of at least `min_bytes` each; more than fit into the file are refused."""
        (count,) = self.take("Q")
        if count * min_bytes > len(self._data) - self._at:
            got = f"{count} in {len(self._data)} bytes"
            raise refusal(str(self.path), wanted="as many entries as the file holds", got=got, fix=COPY_AGAIN)
        return count

    def text(self) -> str:
        """Returns the UTF-8 text up to the next zero byte."""
        end = bytes(self._data[self._at : self._at + 4096]).find(0)
        try:
            if end >= 0:
                return bytes(self._bytes(end + 1))[:-1].decode("utf-8")
        except UnicodeDecodeError:
            pass
        where = f"{self.path}: byte {self._at}"
        raise refusal(where, wanted="the name of an image, UTF-8", got="other bytes", fix=COPY_AGAIN)

    def _bytes(self, num_bytes: int) -> memoryview:
        """The next `num_bytes`."""
        end = self._at + num_bytes
        if end > len(self._data):
            got = f"the end of the file after {len(self._data)} bytes"
            raise refusal(str(self.path), wanted=f"{num_bytes} more bytes at {self._at}", got=got, fix=COPY_AGAIN)
        self._at, taken = end, self._data[self._at : end]
        return taken


def _binary_cameras(path: Path) -> dict[int, CameraEntry]:
    """Cameras of cameras.bin by id."""
    file, cameras = _Binary(path), {}
    for _ in range(file.count(CAMERA_BYTES)):
        camera, model, width, height = file.take("IiQQ")
        where = f"{path}: camera {camera}"
        if not 0 <= model < len(MODELS):  # the number of its parameters is not known, so nothing after it can be read
            supported = ", ".join(name for name, _, supported in MODELS if supported)
            raise refusal(where, wanted=f"one of {supported}", got=f"'model {model}'", fix=UNDISTORT)
        name, params, _ = MODELS[model]
        values = file.take(f"{len(params.split())}d")
        cameras[camera] = CameraEntry(name, (float(width), float(height)), values, where)
    return cameras


def _binary_images(path: Path) -> Iterator[ImageEntry]:
    """Images of images.bin; their 2D points are skipped."""
    file = _Binary(path)
    for _ in range(file.count(IMAGE_BYTES)):
        image, *pose, camera = file.take("I7dI")
        name = file.text()
        file.skip(POINT_BYTES * file.count(POINT_BYTES))
        yield ImageEntry(name, tuple(pose[:4]), tuple(pose[4:]), camera, f"{path}: image {image}")


def _text_cameras(path: Path) -> dict[int, CameraEntry]:
    """Cameras of cameras.txt by id."""
    cameras = {}
    for number, line in load_lines(path):
        if not line:
            continue
        where, words = f"{path}: line {number}", line.split()
        if len(words) < 4:
            raise refusal(where, wanted="id, model, width, height, parameters", got=echo(line), fix=COPY_AGAIN)
        camera, width, height = (_whole(word, where) for word in (words[0], *words[2:4]))
        size = (float(width), float(height))
        cameras[camera] = CameraEntry(words[1], size, tuple(parse_numbers(words[4:], where)), where)
    return cameras


def _text_images(path: Path) -> Iterator[ImageEntry]:
    """Images of images.txt, two lines each: pose and name, and the 2D points (this line may be empty)."""
    lines = iter(load_lines(path))
    for number, line in lines:
        if not line:
            continue
        where, words = f"{path}: line {number}", line.split(maxsplit=9)
        if len(words) != 10:
            wanted = "id, quaternion, translation, camera id, name"
            raise refusal(where, wanted=wanted, got=echo(line), fix=COPY_AGAIN)
        pose = parse_numbers(words[1:8], where)
        points = next(lines, (number, ""))[1].split()
        if len(points) % 3 or (points and not points[-1].lstrip("-").isdigit()):
            raise refusal(where, wanted="a line of 2D points below", got="another line", fix=COPY_AGAIN)
        yield ImageEntry(words[9], tuple(pose[:4]), tuple(pose[4:]), _whole(words[8], where), where)


def _whole(word: str, where: str) -> int:
    """Parses a whole number of up to 18 digits."""
    if word.isascii() and word.isdigit() and len(word) < 19:
        return int(word)
    raise refusal(where, wanted="a whole number", got=echo(word), fix=COPY_AGAIN)
