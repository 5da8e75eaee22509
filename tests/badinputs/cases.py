"""Bad captures, one line each: a name, a function that damages a good capture, and the place that the message names.

A spoiler gets the capture's folder and the contents of its transforms.json, which is written after it has run (unless
the spoiler wrote that file itself).
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from ssplat_jax.core.errors import InputError
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.open_capture import open_capture

WIDTH, HEIGHT, NUM_FRAMES = 64, 48, 4


def make_capture(
    root: Path, change: Callable[[Path, dict[str, Any]], Any] = lambda root, meta: None, num_frames: int = NUM_FRAMES
) -> Path:
    """Writes a good capture to the folder `root`, changed by `change`, and returns the folder."""
    rng, frames = np.random.default_rng(0), []
    (root / "images").mkdir(parents=True)
    for i in range(num_frames):
        pixels = rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(root / "images" / f"{i}.jpg", quality=95)
        pose = np.eye(4)
        pose[0, 3] = 0.1 * i
        frames.append({"file_path": f"images/{i}.jpg", "transform_matrix": pose.tolist()})
    intrinsics = {"fl_x": 50.0, "fl_y": 51.0, "cx": 31.0, "cy": 25.0, "w": WIDTH, "h": HEIGHT}
    meta = {"camera_model": "OPENCV", **intrinsics, "frames": frames}
    change(root, meta)
    if not (root / "transforms.json").exists():
        (root / "transforms.json").write_text(json.dumps(meta))
    return root


def opened(folder: Path, *spoilers) -> Capture:
    """The good capture after what `spoilers` did to it, opened."""
    return open_capture(make_capture(folder / "capture", both(*spoilers)))


def read_capture(path: str | Path) -> Capture:
    """Opens a capture and decodes everything in it."""
    capture = open_capture(path)
    for i in range(len(capture)):
        capture.K(i), capture.image(i), capture.depth(i)
    return capture


def assert_refused(read: Callable[[Path], Any], path: Path, *words: str) -> None:
    """`read(path)` raises an `InputError` of one line that holds `words`."""
    with pytest.raises(InputError) as caught:
        read(path)
    message = str(caught.value)
    assert message.isprintable() and message.isascii() and len(message) < 600
    assert [word for word in words if word not in message] == []


# Functions that damage a capture, or return such a function of (root, meta).


def top(**fields):
    """Sets global fields; None removes a field."""
    return lambda root, meta: _update(meta, fields)


def frame(i, **fields):
    """Sets fields of frame `i`; None removes a field."""
    return lambda root, meta: _update(meta["frames"][i], fields)


def _update(target, fields):
    for name, value in fields.items():
        target.pop(name, None) if value is None else target.update({name: value})


def pose(change):
    """Applies `change` to the matrix of frame 2, a NumPy array."""
    return lambda root, meta: frame(
        2, transform_matrix=change(np.array(meta["frames"][2]["transform_matrix"])).tolist()
    )(root, meta)


def entry(row, column, value):
    """Sets one entry of the matrix of frame 2."""
    return lambda root, meta: meta["frames"][2]["transform_matrix"][row].__setitem__(column, value)


def text(content: str | bytes):
    """Writes the given contents to transforms.json."""
    data = content.encode() if isinstance(content, str) else content
    return lambda root, meta: (root / "transforms.json").write_bytes(data)


def depth_map(i, value, **fields):
    """Gives frame `i` a depth image of 16 bits: `value` in each pixel, or an array."""

    def spoil(root, meta):
        values = value if isinstance(value, np.ndarray) else np.full((HEIGHT, WIDTH), value)
        Image.fromarray(values.astype(np.uint16)).save(root / "d.png")
        frame(i, **{"depth_file_path": "d.png", **fields})(root, meta)

    return spoil


def another(i, name, make):
    """Names another image in frame `i`, which `make` writes to its path."""
    return lambda root, meta: [make(root / "images" / name), frame(i, file_path=f"images/{name}")(root, meta)]


def image(make):
    """Replaces image 2 by some bytes, or by what a function writes to its path."""

    def spoil(root, meta):
        file = root / "images" / "2.jpg"
        file.unlink()
        file.write_bytes(make) if isinstance(make, bytes) else make(file)

    return spoil


def picture(mode, *size, format="JPEG"):
    """Replaces image 2 by a black image."""
    return image(lambda file: Image.new(mode, size).save(file, format=format))


def tiff(pixels, **options):
    """Replaces image 2 by a TIFF."""
    return image(lambda file: Image.fromarray(pixels).save(file, format="TIFF", **options))


def edited(change, file="images/2.jpg"):
    """Changes the bytes of image 2, or of another file."""
    return lambda root, meta: (root / file).write_bytes(change((root / file).read_bytes()))


def both(*spoilers):
    return lambda root, meta: [spoil(root, meta) for spoil in spoilers]


def shrunk_without_a_size(root, meta):
    """Leaves only images_4 with intrinsics of an unknown full size."""
    (root / "images").rename(root / "images_4")
    top(w=None, h=None)(root, meta)


def linked_outside(root, meta):
    (root / "images" / "2.jpg").rename(root.parent / "outside.jpg")
    (root / "images" / "2.jpg").symlink_to(root.parent / "outside.jpg")


def outside(path):
    """Refers to an existing file outside the capture."""

    def spoil(root, meta):
        Image.new("RGB", (WIDTH, HEIGHT)).save(root.parent / "secret.jpg")
        meta["frames"][2]["file_path"] = path.format(parent=root.parent)

    return spoil


NOISE = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
PNG = image(lambda file: Image.fromarray(NOISE).save(file, format="PNG"))
DEPTH = frame(2, depth_file_path="d.png")
MATRIX, PATH, JSON = "frames[2].transform_matrix", "frames[2].file_path", "transforms.json"
IMAGE, FILE = "2.jpg", "frames[2].depth_file_path"

# One line per case, however long.
CASES = (
    # images
    ("missing image", image(lambda file: None), PATH),
    ("garbage image", image(b"not an image at all" * 9), IMAGE),
    ("JPEG cut at 99 %", edited(lambda data: data[: int(0.99 * len(data))]), IMAGE),
    ("folder in place of an image", image(Path.mkdir), PATH),
    ("bomb", picture("1", 20000, 20000, format="PNG"), IMAGE),
    ("an image of another size", picture("RGB", 10, 10), "frames[2]: w, h"),
    ("an image on its side", picture("RGB", HEIGHT, WIDTH), "frames[2]: w, h"),
    ("intrinsics of another size", top(w=128, h=90), "frames[0]: w, h"),
    ("intrinsics of a pixel", top(w=1, h=1), "frames[0]: w, h"),
    ("shrunk, nothing says how far", shrunk_without_a_size, "frames[0]: w, h"),
    ("floats in a TIFF", tiff(np.ones((HEIGHT, WIDTH), np.float32)), IMAGE),
    ("32-bit integers in a TIFF", tiff(np.ones((HEIGHT, WIDTH), np.int32)), IMAGE),
    ("a TIFF on its side", tiff(np.zeros((WIDTH, HEIGHT, 3), np.uint8), tiffinfo={274: 6}), IMAGE),
    ("a TIFF whose zero is white", tiff(np.zeros((HEIGHT, WIDTH), np.uint16), tiffinfo={262: 0}), IMAGE),
    ("two sizes", both(top(w=None, h=None), picture("RGB", 70, 48)), "capture"),
    ("a format that is not read", picture("RGB", WIDTH, HEIGHT, format="TGA"), IMAGE),
    ("PNG with a wrong checksum", both(PNG, edited(lambda data: data[:3000] + bytes(4) + data[3004:])), IMAGE),
    ("a pointer of git-lfs", image(b"version https://git-lfs.github.com/spec/v1\n"), IMAGE),
    # poses
    ("a word in place of a pose", frame(2, transform_matrix="identity"), MATRIX),
    ("a camera beyond the sky", entry(0, 3, 1e308), MATRIX),
    ("NaN pose", entry(0, 3, float("nan")), MATRIX),
    ("zero rotation", pose(lambda m: np.diag([0, 0, 0, 1.0])), MATRIX),
    ("scaled rotation", pose(lambda m: np.diag([2, 2, 2, 1.0])), MATRIX),
    ("sheared by 2e-2", entry(0, 1, 2e-2), MATRIX),
    ("mirrored", pose(lambda m: np.diag([-1, 1, 1, 1.0]) @ m), MATRIX),
    ("transposed", pose(lambda m: m.T), MATRIX),
    ("last row wrong", entry(3, 3, 2.0), MATRIX),
    ("3x3 pose", pose(lambda m: m[:3, :3]), MATRIX),
    ("ragged pose", frame(2, transform_matrix=[[1, 0], [0]]), MATRIX),
    ("integer beyond float64 in a pose", entry(0, 3, 10**400), MATRIX),
    ("no pose", frame(2, transform_matrix=None), MATRIX),
    # intrinsics
    ("focal length 0", top(fl_x=0.0), "frames[0].fl_x"),
    ("focal length below 0", top(fl_y=-50.0), "frames[0].fl_y"),
    ("focal length in units of the image", top(fl_x=0.8, fl_y=1.1), "frames[0].fl_x"),
    ("focal length a word", top(fl_x="50"), "frames[0].fl_x"),
    ("no focal length", top(fl_x=None, fl_y=None), "frames[0].fl_x"),
    ("a focal length missing", both(top(fl_x=None, fl_y=None), frame(0, fl_x=50.0)), "frames[1].fl_x"),
    ("angle in degrees", top(fl_x=None, fl_y=None, camera_angle_x=60.0), "camera_angle_x"),
    ("principal point outside", top(cx=65.0), "frames[0].cx"),
    ("per-frame focal length bad", frame(2, fl_x=-1), "frames[2].fl_x"),
    ("fisheye with tangential terms", top(camera_model="OPENCV_FISHEYE", p1=0.1), "frames[0]"),
    ("fisheye that folds", top(is_fisheye=True, k1=-9.0), "frames[0]"),
    ("unknown camera model", top(camera_model="FISHEYE624"), "undistort"),
    ("a whole sphere", top(camera_model="EQUIRECTANGULAR"), "cut them into perspective views"),
    *((f"{name} set", top(**{name: True}), name) for name in ("equirectangular", "latlong", "orthographic")),
    *((f"a lens with {name}", top(**{name: 0.1}), name) for name in ("k5", "s1", "xi", "ftheta_p1")),
    ("prism terms", top(camera_model="FULL_OPENCV", s1=0.1), "s1"),
    ("two coefficients in a list", top(distortion_params=[0.1, 0.2]), "distortion_params: wanted 6"),
    ("distorted until it folds", top(k1=-2.0), "frames[0]"),
    ("distortion beyond measure", top(k1=1e308), "frames[0]"),
    ("principal point infinite", top(cy=float("inf")), "frames[0].cy"),
    ("fisheye flag a word", top(is_fisheye="yes"), "is_fisheye"),
    # paths
    ("path of the folder", frame(2, file_path="images"), PATH),
    ("path a list", frame(2, file_path=["images/2.jpg"]), PATH),
    ("path outside", outside("../secret.jpg"), PATH),
    ("absolute path outside", outside("{parent}/secret.jpg"), PATH),
    ("link outside", linked_outside, PATH),
    ("link to itself", image(lambda file: file.symlink_to(file)), PATH),
    ("no path", frame(2, file_path=None), PATH),
    ("path empty", frame(2, file_path=""), PATH),
    ("path with a zero byte", frame(2, file_path="a\0b"), PATH),
    ("path of 10000 characters", frame(2, file_path="a" * 10000), PATH),
    ("the same image twice", frame(2, file_path="images/1.jpg"), "frames[2]"),
    ("the same image by another name", frame(2, file_path="./images/../images/1.jpg"), "frames[2]"),
    # depth
    ("missing depth", frame(2, depth_file_path="nowhere.png"), "frames[2].depth_file_path"),
    ("depth outside", frame(2, depth_file_path="../d.png"), "frames[2].depth_file_path"),
    ("depth of 8 bits", both(DEPTH, lambda root, meta: Image.new("L", (WIDTH, HEIGHT)).save(root / "d.png")), "d.png"),
    ("depth cut short", both(depth_map(2, 1000), edited(lambda data: data[:60], "d.png")), "d.png"),
    ("depth is a JPEG", frame(2, depth_file_path="images/1.jpg"), "1.jpg"),
    ("a unit of two meanings", depth_map(2, 1, depth_scale=1000), "depth_scale: wanted integer_depth_scale"),
    ("depth a folder", both(DEPTH, lambda root, meta: (root / "d.png").mkdir()), FILE),
    # the container
    ("comma at the end", text('{"frames": [],}'), JSON),
    ("Latin-1", text('{"a": "\u00e9"}'.encode("latin-1")), JSON),
    ("empty file", text(""), JSON),
    ("nested without end", text("[" * 100_000), JSON),
    ("a key twice", text('{"fl_x": 1, "fl_x": 2, "frames": []}'), JSON),
    ("a list", text("[1, 2]"), JSON),
    ("no frames", top(frames=None), JSON),
    ("zero frames", top(frames=[]), JSON),
    ("a frame is null", lambda root, meta: meta["frames"].__setitem__(2, None), "frames[2]"),
    ("transforms.json is a folder", lambda root, meta: (root / "transforms.json").mkdir(), "capture"),
)  # fmt: skip
