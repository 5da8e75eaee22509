"""Bad captures, one line each: a name, a function that damages a good capture, and the place that the message names.

A spoiler gets the capture's folder and the contents of its transforms.json, which is written after it has run (unless
the spoiler wrote that file itself).
"""

import json
import math
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from ssplat_jax.data.capture import Capture
from ssplat_jax.data.open_capture import open_capture

WIDTH, HEIGHT, NUM_FRAMES = 64, 48, 4


class Case(NamedTuple):
    name: str
    spoil: Callable[[Path, dict[str, Any]], Any]
    where: str


def make_capture(root: Path, change: Callable[[Path, dict[str, Any]], Any] = lambda root, meta: None) -> Path:
    """Writes a good capture to the folder `root`, changed by `change`, and returns the folder."""
    rng, frames = np.random.default_rng(0), []
    (root / "images").mkdir(parents=True)
    for i in range(NUM_FRAMES):
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


def mutant(data: bytes, rng: random.Random) -> bytes:
    """`data` after a few random edits: bytes are changed, removed, repeated or replaced."""
    out = bytearray(data)
    for _ in range(rng.randint(1, 6)):
        at = rng.randrange(len(out))
        kind = rng.randrange(4)
        if kind == 0:
            out[at] = rng.randrange(256)
        elif kind == 1:
            del out[at : at + rng.randint(1, 30)]
        elif kind == 2:
            out[at:at] = out[at : at + rng.randint(1, 30)]
        else:
            out[at : at + 1] = rng.choice([b"-", b"1e999", b"null", b"{", b"]", b'"', b"0", b"NaN", b"\xff"])
        if not out:
            return b""
    return bytes(out)


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


def truncated(fraction):
    """Truncates image 2."""

    def spoil(root, meta):
        file = root / "images" / "2.jpg"
        file.write_bytes(file.read_bytes()[: int(fraction * file.stat().st_size)])

    return spoil


def picture(mode, *size, format="JPEG"):
    """Replaces image 2 by a black image."""
    return image(lambda file: Image.new(mode, size).save(file, format=format))


def tiff(pixels, **options):
    """Replaces image 2 by a TIFF."""
    return image(lambda file: Image.fromarray(pixels).save(file, format="TIFF", **options))


def damaged_png(change):
    """Replaces image 2 by a PNG whose bytes `change` damages."""

    def make(file):
        Image.fromarray(np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)).save(
            file, format="PNG"
        )
        file.write_bytes(change(file.read_bytes()))

    return image(make)


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


def depth(make):
    """Gives frame 2 the depth map d.png, which `make` puts there."""

    def spoil(root, meta):
        make(root / "d.png")
        meta["frames"][2]["depth_file_path"] = "d.png"

    return spoil


def cut(file):
    Image.new("I;16", (WIDTH, HEIGHT), 1000).save(file)
    file.write_bytes(file.read_bytes()[:60])


def rotated(degrees):
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])


MATRIX, PATH, JSON = "frames[2].transform_matrix", "frames[2].file_path", "transforms.json"
IMAGE, FILE = "2.jpg", "frames[2].depth_file_path"

# One line per case, however long.
CASES = (
    # images
    Case("missing image", image(lambda file: None), PATH),
    Case("garbage image", image(b"not an image at all" * 9), IMAGE),
    Case("JPEG cut at 50 %", truncated(0.5), IMAGE),
    Case("JPEG cut at 99 %", truncated(0.99), IMAGE),
    Case("folder in place of an image", image(Path.mkdir), PATH),
    Case("bomb", picture("1", 20000, 20000, format="PNG"), IMAGE),
    Case("an image of another size", picture("RGB", 10, 10), "frames[2]: w, h"),
    Case("an image on its side", picture("RGB", HEIGHT, WIDTH), "frames[2]: w, h"),
    Case("intrinsics of another size", top(w=128, h=90), "frames[0]: w, h"),
    Case("intrinsics of a pixel", top(w=1, h=1), "frames[0]: w, h"),
    Case("shrunk, nothing says how far", shrunk_without_a_size, "frames[0]: w, h"),
    Case("floats in a TIFF", tiff(np.ones((HEIGHT, WIDTH), np.float32)), IMAGE),
    Case("32-bit integers in a TIFF", tiff(np.ones((HEIGHT, WIDTH), np.int32)), IMAGE),
    Case("a TIFF on its side", tiff(np.zeros((WIDTH, HEIGHT, 3), np.uint8), tiffinfo={274: 6}), IMAGE),
    Case("two sizes", both(top(w=None, h=None), picture("RGB", 70, 48)), "capture"),
    Case("a format that is not read", picture("RGB", WIDTH, HEIGHT, format="TGA"), IMAGE),
    Case("PNG with a wrong checksum", damaged_png(lambda d: d[:3000] + b"\0\0\0\0" + d[3004:]), IMAGE),
    Case("a pointer of git-lfs", image(b"version https://git-lfs.github.com/spec/v1\n"), IMAGE),
    # poses
    Case("a word in place of a pose", frame(2, transform_matrix="identity"), MATRIX),
    Case("5x5 pose", pose(lambda m: np.eye(5)), MATRIX),
    Case("a camera beyond the sky", entry(0, 3, 1e308), MATRIX),
    Case("NaN pose", entry(0, 3, float("nan")), MATRIX),
    Case("zero rotation", pose(lambda m: np.diag([0, 0, 0, 1.0])), MATRIX),
    Case("scaled rotation", pose(lambda m: np.diag([2, 2, 2, 1.0])), MATRIX),
    Case("sheared by 2e-2", entry(0, 1, 2e-2), MATRIX),
    Case("mirrored", pose(lambda m: np.diag([-1, 1, 1, 1.0]) @ m), MATRIX),
    Case("transposed", pose(lambda m: m.T), MATRIX),
    Case("last row wrong", entry(3, 3, 2.0), MATRIX),
    Case("3x3 pose", pose(lambda m: m[:3, :3]), MATRIX),
    Case("ragged pose", frame(2, transform_matrix=[[1, 0], [0]]), MATRIX),
    Case("pose of nulls", entry(0, 0, None), MATRIX),
    Case("integer beyond float64 in a pose", entry(0, 3, 10**400), MATRIX),
    Case("no pose", frame(2, transform_matrix=None), MATRIX),
    # intrinsics
    Case("focal length 0", top(fl_x=0.0), "frames[0].fl_x"),
    Case("focal length below 0", top(fl_y=-50.0), "frames[0].fl_y"),
    Case("focal length in units of the image", top(fl_x=0.8, fl_y=1.1), "frames[0].fl_x"),
    Case("focal length a word", top(fl_x="50"), "frames[0].fl_x"),
    Case("focal length true", top(fl_x=True), "frames[0].fl_x"),
    Case("no focal length", top(fl_x=None, fl_y=None), "frames[0].fl_x"),
    Case("a focal length missing", both(top(fl_x=None, fl_y=None), frame(0, fl_x=50.0)), "frames[1].fl_x"),
    Case("angle in degrees", top(fl_x=None, fl_y=None, camera_angle_x=60.0), "camera_angle_x"),
    Case("principal point outside", top(cx=65.0), "frames[0].cx"),
    Case("per-frame focal length bad", frame(2, fl_x=-1), "frames[2].fl_x"),
    Case("fisheye with tangential terms", top(camera_model="OPENCV_FISHEYE", p1=0.1), "frames[0]"),
    Case("fisheye that folds", top(is_fisheye=True, k1=-9.0), "frames[0]"),
    Case("unknown camera model", top(camera_model="EQUIRECTANGULAR"), "camera_model"),
    Case("distorted until it folds", top(k1=-2.0), "frames[0]"),
    Case("distortion beyond measure", top(k1=1e308), "frames[0]"),
    Case("principal point infinite", top(cy=float("inf")), "frames[0].cy"),
    Case("width a word", top(w="64"), "frames[0].w"),
    Case("distortion a word", top(k1="none"), "frames[0].k1"),
    Case("camera model a number", top(camera_model=5), "camera_model"),
    Case("fisheye flag a word", top(is_fisheye="yes"), "is_fisheye"),
    # paths
    Case("path of the folder", frame(2, file_path="images"), PATH),
    Case("path a list", frame(2, file_path=["images/2.jpg"]), PATH),
    Case("path outside", outside("../secret.jpg"), PATH),
    Case("absolute path outside", outside("{parent}/secret.jpg"), PATH),
    Case("link outside", linked_outside, PATH),
    Case("link to itself", image(lambda file: file.symlink_to(file)), PATH),
    Case("no path", frame(2, file_path=None), PATH),
    Case("path empty", frame(2, file_path=""), PATH),
    Case("path with a zero byte", frame(2, file_path="a\0b"), PATH),
    Case("path of 10000 characters", frame(2, file_path="a" * 10000), PATH),
    Case("the same image twice", frame(2, file_path="images/1.jpg"), "frames[2]"),
    Case("the same image by another name", frame(2, file_path="./images/../images/1.jpg"), "frames[2]"),
    # depth
    Case("missing depth", frame(2, depth_file_path="nowhere.png"), "frames[2].depth_file_path"),
    Case("depth outside", frame(2, depth_file_path="../d.png"), "frames[2].depth_file_path"),
    Case("depth of 8 bits", depth(lambda file: Image.new("L", (WIDTH, HEIGHT)).save(file)), "d.png"),
    Case("depth cut short", depth(cut), "d.png"),
    Case("depth is a JPEG", frame(2, depth_file_path="images/1.jpg"), "1.jpg"),
    Case("depth a folder", depth(lambda file: file.mkdir()), FILE),
    # the container
    Case("comma at the end", text('{"frames": [],}'), JSON),
    Case("Python in place of JSON", text("{'fl_x': None}"), JSON),
    Case("Latin-1", text('{"a": "\u00e9"}'.encode("latin-1")), JSON),
    Case("frames a word", top(frames="all"), JSON),
    Case("a frame is a number", lambda root, meta: meta["frames"].__setitem__(2, 7), "frames[2]"),
    Case("empty file", text(""), JSON),
    Case("cut short", text('{"frames": [{"file_path": "im'), JSON),
    Case("nested without end", text("[" * 100_000), JSON),
    Case("a key twice", text('{"fl_x": 1, "fl_x": 2, "frames": []}'), JSON),
    Case("a list", text("[1, 2]"), JSON),
    Case("no frames", top(frames=None), JSON),
    Case("zero frames", top(frames=[]), JSON),
    Case("a frame is null", lambda root, meta: meta["frames"].__setitem__(2, None), "frames[2]"),
    Case("transforms.json is a folder", lambda root, meta: (root / "transforms.json").mkdir(), "capture"),
)  # fmt: skip
