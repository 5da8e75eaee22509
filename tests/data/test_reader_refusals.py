"""Unusable files of every format are refused in one line that names the place; tests/fuzzing damages them at random."""

import struct

import numpy as np
import pytest

from ssplat_jax.data.open_capture import open_capture
from tests.badinputs.cases import WIDTH, assert_refused
from tests.data.capture_writers import (
    CX,
    CY,
    FX,
    FY,
    WRITERS,
    camera_bytes,
    edit_json,
    edit_text,
    matrix_text,
    remove,
    write_image,
)

CAMERAS = "sparse/0/cameras.bin"


def replace(file, old, new):
    return edit_text(file, lambda text: text.replace(old, new, 1))


def write(file, data):
    return lambda root: (root / file).write_bytes(data)


def camera(model, params, **options):
    return write(CAMERAS, struct.pack("<Q", 1) + camera_bytes(model, params, **options))


def with_terms(terms, kind="frame"):
    """Terms of a lens for Metashape."""
    return edit_text(
        "cameras.xml", lambda text: text.replace('type="frame"', f'type="{kind}"').replace("<b1>", f"{terms}<b1>")
    )


WITH_K5 = edit_text("cameras.csv", lambda text: text.replace("k4", "k5").replace(",0,0,0\n", ",0.3,0,0\n"))
TWO_MATRICES = b"1170 0 647 0\n0 1170 483 0\n0 0 1 0\n0 0 0 1\n"

BAD = (
    ("COLMAP", "no cameras.bin", remove(CAMERAS), "cameras.bin"),
    ("COLMAP", "model to come", camera(77, ()), "model 77"),
    ("COLMAP", "other camera", camera(1, (FX, FY, CX, CY), camera=2), "camera 1, which is missing"),
    ("COLMAP text", "parameters missing", replace("sparse/0/cameras.txt", f" {CY}", ""), "line 2"),
    ("COLMAP text", "image twice", replace("sparse/0/images.txt", "10.jpg", "9.jpg"), "line 9"),
    ("ScanNet", "a scale", write("pose/9.txt", matrix_text(2 * np.eye(4)).encode()), "9.txt"),
    ("ScanNet", "of another size", write("intrinsic/intrinsic_color.txt", TWO_MATRICES), "intrinsic_color.txt"),
    ("TUM RGB-D", "no calibration", remove("calibration.txt"), "freiburg"),
    ("TUM RGB-D", "other times", write("groundtruth.txt", b"1 0 0 0 0 0 0 1\n"), "pose at their time"),
    ("RealEstate10K", "time twice", replace("0a1b.txt", "\n123367 ", "\n90000 "), "line 3"),
    ("RealEstate10K", "pixels", replace("0a1b.txt", f" {FX / WIDTH} ", " -1 "), "line 2"),
    ("cameras.json", "no width", replace("cameras.json", '"width"', '"w"'), "[0].width"),
    ("Polycam", "mirrored", replace("keyframes/cameras/7001.json", '"t_00": ', '"t_00": -'), "7001.json"),
    ("LLFF", "too many", lambda root: write_image(root / "images" / "IMG_4.JPG"), "wanted 4 images"),
    ("LLFF", "fifteen columns", lambda root: np.save(root / "poses_bounds.npy", np.zeros((4, 15))), "(4, 15)"),
    ("KITTI", "no line P2", write("calib.txt", b"P0: 1\n"), "calib.txt"),
    # Skew, which none of our camera models has.
    ("ScanNet", "skew", replace("intrinsic/intrinsic_color.txt", "50.0 0.0 31.0", "50.0 5.0 31.0"), "without skew"),
    ("KITTI", "skew", replace("calib.txt", "50.0 0.0 30.5", "50.0 5.0 30.5"), "without skew"),
    ("Record3D", "skew", edit_json("metadata.json", K=[50, 0, 0, 5, 51, 0, 31, 25, 1]), "without skew"),
    ("cameras.json", "a lens", edit_json("cameras.json", k1=0.2), "[0].k1"),
    ("Polycam", "a lens", edit_json("keyframes/cameras/7001.json", distortion=[0.1, 0, 0, 0]), "distortion"),
    ("RealityCapture", "k5", WITH_K5, "k5"),
    ("Metashape", "p3", with_terms("<p3>1</p3>"), "p3"),
    ("Metashape", "b2", with_terms("<b2>3</b2>"), "b2"),
    ("Metashape", "a whole sphere", with_terms("", "spherical"), "perspective views"),
    ("Metashape", "tangential fisheye", with_terms("<p1>0.01</p1>", "fisheye"), "p1 or p2"),
)


@pytest.mark.parametrize(("kind", "name", "spoil", "where"), BAD, ids=[f"{kind}-{name}" for kind, name, *_ in BAD])
def test_bad_files_are_refused_in_one_line(kind, name, spoil, where, tmp_path):
    WRITERS[kind](tmp_path)
    spoil(tmp_path)
    assert_refused(open_capture, tmp_path, where, "wanted")
