"""Damaged and unusable files of every format are refused in one line."""

import json
import random
import struct

import numpy as np
import pytest

from ssplat_jax.core.errors import InputError
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.data.posed_image import MAX_COORDINATE, pose_from_quat
from tests.badinputs.cases import mutant
from tests.data.capture_writers import (
    CX,
    CY,
    FX,
    FY,
    WIDTH,
    WRITERS,
    camera_bytes,
    matrix_text,
    write_image,
)

NUM_MUTANTS = 150  # per file; seeded, so that failures can be repeated


def replace(file, old, new, count=1):
    def spoil(root):
        text = (root / file).read_text()
        assert old in text
        (root / file).write_text(text.replace(old, new, count))

    return spoil


def write(file, data):
    return lambda root: (root / file).write_bytes(data)


def cut(file, num_bytes):
    return lambda root: (root / file).write_bytes((root / file).read_bytes()[:-num_bytes])


def remove(file):
    return lambda root: (root / file).unlink()


def empty(folder):
    return lambda root: [file.unlink() for file in (root / folder).rglob("*.jpg")]


def _edit_json(file, change):
    contents = json.loads(file.read_text())
    change(contents)
    file.write_text(json.dumps(contents))


def camera(model, params):
    return write("sparse/0/cameras.bin", struct.pack("<Q", 1) + camera_bytes(model, params))


BAD = {
    # COLMAP, binary
    "no cameras.bin": ("COLMAP", remove("sparse/0/cameras.bin"), ("cameras.bin", "readable")),
    "images.bin empty": ("COLMAP", write("sparse/0/images.bin", b""), ("images.bin", "end of the file")),
    "images.bin cut": ("COLMAP", cut("sparse/0/images.bin", 5), ("images.bin",)),
    "images.bin counts 2^63": ("COLMAP", write("sparse/0/images.bin", struct.pack("<Q", 1 << 63)), ("9223372036",)),
    "no image registered": ("COLMAP", write("sparse/0/images.bin", struct.pack("<Q", 0)), ("registered",)),
    "field of view": ("COLMAP", camera(7, (FX, FY, CX, CY, 0.9)), ("FOV", "image_undistorter")),
    "fish-eye that folds": ("COLMAP", camera(5, (FX, FY, CX, CY, -9, 0, 0, 0)), ("fold", "k1=-9")),
    "model to come": ("COLMAP", camera(77, ()), ("model 77", "image_undistorter")),
    "denominator": ("COLMAP", camera(6, (FX, FY, CX, CY, 0, 0, 0, 0, 0, 0.1, 0, 0)), ("FULL_OPENCV", "k4")),
    "focal length 0": ("COLMAP", camera(0, (0, CX, CY)), ("camera 1", "focal length")),
    "lens that folds": ("COLMAP", camera(2, (FX, CX, CY, -9.0)), ("fold", "k1=-9")),
    "other camera": (
        "COLMAP",
        write("sparse/0/cameras.bin", struct.pack("<Q", 1) + camera_bytes(1, (FX, FY, CX, CY), camera=2)),
        ("camera 1, which is missing",),
    ),
    "images missing": ("COLMAP", empty("images"), ("10.jpg", "does not exist")),
    "image of another size": (
        "COLMAP",
        lambda root: write_image(root / "images" / "9.jpg", 0, (WIDTH, WIDTH)),
        ("64x48", "64x64", "that COLMAP used"),
    ),
    # COLMAP, text
    "no cameras.txt": ("COLMAP text", remove("sparse/0/cameras.txt"), ("cameras.txt",)),
    "parameters missing": ("COLMAP text", replace("sparse/0/cameras.txt", f" {CY}", ""), ("4 parameters", "line 2")),
    "no number": ("COLMAP text", replace("sparse/0/cameras.txt", "50.0", "50,0"), ("'50,0'", "line 2")),
    "image twice": ("COLMAP text", replace("sparse/0/images.txt", "10.jpg", "9.jpg"), ("twice",)),
    "line of points missing": ("COLMAP text", replace("sparse/0/images.txt", "1.5 2.5 -1 3.5 4.5 17\n", ""), ("2D",)),
    "outside": ("COLMAP text", replace("sparse/0/images.txt", "9.jpg", "../../../../etc/hosts"), ("inside",)),
    "NaN pose": ("COLMAP text", replace("sparse/0/images.txt", "\n7 ", "\n7 nan "), ("line",)),
    "not UTF-8": ("COLMAP text", write("sparse/0/images.txt", b"\xff\xfe1"), ("UTF-8",)),
    # ScanNet
    "no intrinsics": ("ScanNet", remove("intrinsic/intrinsic_color.txt"), ("intrinsic_color.txt", "exist")),
    "pose of three rows": ("ScanNet", write("pose/9.txt", b"1 0 0 0\n0 1 0 0\n0 0 1 0\n"), ("9.txt", "four rows")),
    "pose with a scale": ("ScanNet", write("pose/9.txt", matrix_text(2 * np.eye(4)).encode()), ("9.txt",)),
    "all lost": (
        "ScanNet",
        lambda root: [file.write_text("-inf -inf -inf -inf\n" * 4) for file in (root / "pose").iterdir()],
        ("4 images", "finite pose"),
    ),
    "intrinsics of another size": (
        "ScanNet",
        write("intrinsic/intrinsic_color.txt", b"1170 0 647 0\n0 1170 483 0\n0 0 1 0\n0 0 0 1\n"),
        ("intrinsic_color.txt", "cx"),
    ),
    # TUM RGB-D
    "no calibration": ("TUM RGB-D", remove("calibration.txt"), ("calibration.txt", "freiburg")),
    "short calibration": ("TUM RGB-D", write("calibration.txt", b"500 500"), ("fx fy cx cy", "2 numbers")),
    "seven columns": ("TUM RGB-D", write("groundtruth.txt", b"1 0 0 0 0 0 1\n"), ("line 1", "8 numbers")),
    "other times": ("TUM RGB-D", write("groundtruth.txt", b"1 0 0 0 0 0 0 1\n"), ("none at the same time",)),
    "zero quaternion": (
        "TUM RGB-D",
        lambda root: (root / "groundtruth.txt").write_text(
            "\n".join(f"{1305031102.2 + 0.05 * i} 0 0 0 0 0 0 0" for i in range(5))
        ),
        ("quaternion of length 0",),
    ),
    "no file beside the time": ("TUM RGB-D", write("rgb.txt", b"1305031102.25\n"), ("line 1", "a time and a file")),
    # RealEstate10K
    "wrong columns": ("RealEstate10K", replace("0a1b.txt", " 0.0 0.0", " 0.0"), ("line 2", "19 numbers")),
    "time twice": ("RealEstate10K", replace("0a1b.txt", "\n123367 ", "\n90000 "), ("line 3", "twice")),
    "time of no number": ("RealEstate10K", replace("0a1b.txt", "\n90000 ", "\nnan "), ("line 2", "microseconds")),
    "no images": (
        "RealEstate10K",
        lambda root: [file.unlink() for file in (root / "0a1b").iterdir()],
        ("none of 4", "90000.jpg"),
    ),
    # cameras.json
    "no list": ("cameras.json", write("cameras.json", b"[3]"), ("list of objects", "[3]")),
    "no width": ("cameras.json", replace("cameras.json", '"width"', '"w"'), ("[0].width", "nothing")),
    "rotation of four numbers": (
        "cameras.json",
        lambda root: _edit_json(root / "cameras.json", lambda entries: entries[1].update(rotation=[1, 0, 0, 0])),
        ("[1].rotation", "3 x 3"),
    ),
    "camera twice": (
        "cameras.json",
        lambda root: _edit_json(root / "cameras.json", lambda entries: entries[1].update(img_name="frame_0")),
        ("[1]", "every image once"),
    ),
    # Polycam
    "no t_23": ("Polycam", replace("keyframes/cameras/7001.json", '"t_23"', '"t_33"'), ("7001.json.t_23", "nothing")),
    "mirrored": (
        "Polycam",
        lambda root: _edit_json(root / "keyframes/cameras/7001.json", lambda f: f.update(t_00=-f["t_00"])),
        ("7001.json",),
    ),
    # Record3D
    "eight numbers": ("Record3D", replace("metadata.json", '"K": [', '"K": [1, '), ("metadata.json.K", "9 finite")),
    "pose of six numbers": (
        "Record3D",
        lambda root: _edit_json(root / "metadata.json", lambda meta: meta["poses"][2].pop()),
        ("poses[2]", "7 finite"),
    ),
    # LLFF
    "image too many": ("LLFF", lambda root: write_image(root / "images" / "IMG_4.JPG"), ("wanted 4 images", "got 5")),
    "fifteen columns": (
        "LLFF",
        lambda root: np.save(root / "poses_bounds.npy", np.zeros((4, 15))),
        ("rows of 17", "(4, 15)"),
    ),
    "pickled": ("LLFF", lambda root: np.save(root / "poses_bounds.npy", np.array([{}])), ("NumPy cannot read",)),
    # KITTI
    "no line P2": ("KITTI", write("calib.txt", b"P0: 1\n"), ("calib.txt", "P2")),
    "eleven numbers": ("KITTI", replace("calib.txt", "P2: 50.0", "P2:"), ("line 3", "12 numbers")),
    "no poses": ("KITTI", remove("poses.txt"), ("poses.txt", "download")),
    "intrinsics in pixels": ("RealEstate10K", replace("0a1b.txt", f" {FX / WIDTH} ", " -1 "), ("line 2", "focal")),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_refused_in_one_line(name, tmp_path):
    kind, spoil, mentions = BAD[name]
    WRITERS[kind](tmp_path)
    spoil(tmp_path)
    with pytest.raises(InputError) as caught:
        open_capture(tmp_path)
    message = str(caught.value)
    assert "\n" not in message and message.isascii() and len(message) < 600
    assert "wanted" in message and "; " in message
    for words in mentions:
        assert words in message, f"{words!r} is not in {message!r}"


FILES = {
    "COLMAP": ("sparse/0/cameras.bin", "sparse/0/images.bin"),
    "COLMAP text": ("sparse/0/cameras.txt", "sparse/0/images.txt"),
    "ScanNet": ("pose/9.txt", "intrinsic/intrinsic_color.txt"),
    "TUM RGB-D": ("rgb.txt", "depth.txt", "groundtruth.txt", "calibration.txt"),
    "RealEstate10K": ("0a1b.txt",),
    "cameras.json": ("cameras.json",),
    "Polycam": ("keyframes/cameras/7000.json",),
    "Record3D": ("metadata.json",),
    "LLFF": ("poses_bounds.npy",),
    "KITTI": ("calib.txt", "poses.txt"),
}


@pytest.mark.parametrize(("kind", "file"), [(kind, file) for kind, files in FILES.items() for file in files])
def test_mutants_are_read_or_refused_and_never_crash(kind, file, tmp_path):
    WRITERS[kind](tmp_path)
    good, rng, num_refused = (tmp_path / file).read_bytes(), random.Random(file), 0
    for _ in range(NUM_MUTANTS):
        (tmp_path / file).write_bytes(mutant(good, rng))
        try:
            capture = open_capture(tmp_path)
            assert np.isfinite(capture.camtoworlds).all() and all(np.isfinite(f.K).all() for f in capture.frames)
        except InputError as error:
            assert "\n" not in str(error)
            num_refused += 1
    assert num_refused > NUM_MUTANTS // 20  # enough mutants reach the checks


def test_a_pose_of_a_quaternion_may_not_be_absurdly_far():
    turn = [1.0, 0.0, 0.0, 0.0]
    assert pose_from_quat(turn, [0.0, -MAX_COORDINATE, 0.0], "here")[1, 3] == -MAX_COORDINATE
    with pytest.raises(InputError, match=r"^here: wanted coordinates up to 1e\+12, got 2e\+12; drop the frame"):
        pose_from_quat(turn, [0.0, 0.0, -2e12], "here")
