"""Damaged and unusable files of every format are refused in one line that names the place."""

import json
import struct

import numpy as np
import pytest

from ssplat_jax.core.errors import InputError
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.data.posed_image import MAX_COORDINATE, pose_from_quat
from tests.data.capture_writers import CX, CY, FX, FY, WIDTH, WRITERS, camera_bytes, matrix_text, write_image

CAMERAS, IMAGES = "sparse/0/cameras.bin", "sparse/0/images.bin"


def replace(file, old, new):
    def spoil(root):
        text = (root / file).read_text()
        assert old in text
        (root / file).write_text(text.replace(old, new, 1))

    return spoil


def write(file, data):
    return lambda root: (root / file).write_bytes(data)


def cut(file, num_bytes):
    return lambda root: (root / file).write_bytes((root / file).read_bytes()[:-num_bytes])


def remove(pattern):
    return lambda root: [file.unlink() for file in root.glob(pattern)]


def edit(file, change):
    def spoil(root):
        contents = json.loads((root / file).read_text())
        change(contents)
        (root / file).write_text(json.dumps(contents))

    return spoil


def camera(model, params, **options):
    return write(CAMERAS, struct.pack("<Q", 1) + camera_bytes(model, params, **options))


def all_lost(root):
    for file in (root / "pose").iterdir():
        file.write_text("-inf -inf -inf -inf\n" * 4)


TWO_MATRICES = b"1170 0 647 0\n0 1170 483 0\n0 0 1 0\n0 0 0 1\n"
ZERO_TURNS = "\n".join(f"{1305031102.2 + 0.05 * i} 0 0 0 0 0 0 0" for i in range(5)).encode()

BAD = (
    ("COLMAP", "no cameras.bin", remove(CAMERAS), "cameras.bin"),
    ("COLMAP", "images.bin empty", write(IMAGES, b""), "images.bin"),
    ("COLMAP", "images.bin cut", cut(IMAGES, 5), "images.bin"),
    ("COLMAP", "images.bin counts 2^63", write(IMAGES, struct.pack("<Q", 1 << 63)), "images.bin"),
    ("COLMAP", "no image registered", write(IMAGES, struct.pack("<Q", 0)), "none of 0"),
    ("COLMAP", "field of view", camera(7, (FX, FY, CX, CY, 0.9)), "FOV"),
    ("COLMAP", "fish-eye that folds", camera(5, (FX, FY, CX, CY, -9, 0, 0, 0)), "k1=-9"),
    ("COLMAP", "model to come", camera(77, ()), "model 77"),
    ("COLMAP", "denominator", camera(6, (FX, FY, CX, CY, 0, 0, 0, 0, 0, 0.1, 0, 0)), "FULL_OPENCV"),
    ("COLMAP", "focal length 0", camera(0, (0, CX, CY)), "camera 1"),
    ("COLMAP", "other camera", camera(1, (FX, FY, CX, CY), camera=2), "camera 1, which is missing"),
    ("COLMAP", "images missing", remove("images/**/*.jpg"), "10.jpg"),
    ("COLMAP", "another size", lambda root: write_image(root / "images/9.jpg", 0, (WIDTH, WIDTH)), "64x64 in 9.jpg"),
    ("COLMAP text", "no cameras.txt", remove("sparse/0/cameras.txt"), "cameras.txt"),
    ("COLMAP text", "parameters missing", replace("sparse/0/cameras.txt", f" {CY}", ""), "line 2"),
    ("COLMAP text", "no number", replace("sparse/0/cameras.txt", "50.0", "50,0"), "line 2"),
    ("COLMAP text", "image twice", replace("sparse/0/images.txt", "10.jpg", "9.jpg"), "line 9"),
    ("COLMAP text", "no points", replace("sparse/0/images.txt", "1.5 2.5 -1 3.5 4.5 17\n", ""), "line of 2D points"),
    ("COLMAP text", "outside", replace("sparse/0/images.txt", "9.jpg", "../../../../etc/hosts"), "inside"),
    ("COLMAP text", "NaN pose", replace("sparse/0/images.txt", "\n7 ", "\n7 nan "), "line 5"),
    ("COLMAP text", "not UTF-8", write("sparse/0/images.txt", b"\xff\xfe1"), "images.txt"),
    ("ScanNet", "no intrinsics", remove("intrinsic/intrinsic_color.txt"), "intrinsic_color.txt"),
    ("ScanNet", "three rows", write("pose/9.txt", b"1 0 0 0\n0 1 0 0\n0 0 1 0\n"), "9.txt"),
    ("ScanNet", "a scale", write("pose/9.txt", matrix_text(2 * np.eye(4)).encode()), "9.txt"),
    ("ScanNet", "all lost", all_lost, "none of 4"),
    ("ScanNet", "of another size", write("intrinsic/intrinsic_color.txt", TWO_MATRICES), "intrinsic_color.txt"),
    ("TUM RGB-D", "no calibration", remove("calibration.txt"), "freiburg"),
    ("TUM RGB-D", "short calibration", write("calibration.txt", b"500 500"), "fx fy cx cy"),
    ("TUM RGB-D", "seven columns", write("groundtruth.txt", b"1 0 0 0 0 0 1\n"), "line 1"),
    ("TUM RGB-D", "other times", write("groundtruth.txt", b"1 0 0 0 0 0 0 1\n"), "pose at their time"),
    ("TUM RGB-D", "zero quaternion", write("groundtruth.txt", ZERO_TURNS), "quaternion of length 0"),
    ("TUM RGB-D", "no file beside the time", write("rgb.txt", b"1305031102.25\n"), "line 1"),
    ("RealEstate10K", "wrong columns", replace("0a1b.txt", " 0.0 0.0", " 0.0"), "line 2"),
    ("RealEstate10K", "time twice", replace("0a1b.txt", "\n123367 ", "\n90000 "), "line 3"),
    ("RealEstate10K", "time of no number", replace("0a1b.txt", "\n90000 ", "\nnan "), "line 2"),
    ("RealEstate10K", "no images", remove("0a1b/*"), "90000.jpg"),
    ("RealEstate10K", "pixels", replace("0a1b.txt", f" {FX / WIDTH} ", " -1 "), "line 2"),
    ("cameras.json", "no list of objects", write("cameras.json", b"[3]"), "[0]"),
    ("cameras.json", "no width", replace("cameras.json", '"width"', '"w"'), "[0].width"),
    ("cameras.json", "bad turn", edit("cameras.json", lambda e: e[1].update(rotation=[1, 0, 0, 0])), "[1].rotation"),
    ("cameras.json", "camera twice", edit("cameras.json", lambda e: e[1].update(img_name="frame_0")), "[1]"),
    ("Polycam", "no t_23", replace("keyframes/cameras/7001.json", '"t_23"', '"t_33"'), "7001.json.t_23"),
    ("Polycam", "mirrored", edit("keyframes/cameras/7001.json", lambda f: f.update(t_00=-f["t_00"])), "7001.json"),
    ("Record3D", "ten numbers", replace("metadata.json", '"K": [', '"K": [1, '), "metadata.json.K"),
    ("Record3D", "pose of six numbers", edit("metadata.json", lambda meta: meta["poses"][2].pop()), "poses[2]"),
    ("LLFF", "too many", lambda root: write_image(root / "images" / "IMG_4.JPG"), "wanted 4 images"),
    ("LLFF", "fifteen columns", lambda root: np.save(root / "poses_bounds.npy", np.zeros((4, 15))), "(4, 15)"),
    ("LLFF", "pickled", lambda root: np.save(root / "poses_bounds.npy", np.array([{}])), "poses_bounds.npy"),
    ("KITTI", "no line P2", write("calib.txt", b"P0: 1\n"), "calib.txt"),
    ("KITTI", "eleven numbers", replace("calib.txt", "P2: 50.0", "P2:"), "line 3"),
    ("KITTI", "no poses", remove("poses.txt"), "poses.txt"),
)


@pytest.mark.parametrize(("kind", "name", "spoil", "where"), BAD, ids=[f"{kind}-{name}" for kind, name, *_ in BAD])
def test_bad_files_are_refused_in_one_line(kind, name, spoil, where, tmp_path):
    WRITERS[kind](tmp_path)
    spoil(tmp_path)
    with pytest.raises(InputError) as caught:
        open_capture(tmp_path)
    message = str(caught.value)
    assert "\n" not in message and message.isascii() and len(message) < 600 and "wanted" in message
    assert where in message


def test_a_pose_of_a_quaternion_may_not_be_absurdly_far():
    turn = [1.0, 0.0, 0.0, 0.0]
    assert pose_from_quat(turn, [0.0, -MAX_COORDINATE, 0.0], "here")[1, 3] == -MAX_COORDINATE
    with pytest.raises(InputError, match="here: wanted coordinates"):
        pose_from_quat(turn, [0.0, 0.0, -2e12], "here")
