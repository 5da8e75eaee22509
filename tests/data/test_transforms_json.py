"""The transforms.json reader: conventions, defaults, odd files, notes for the user."""

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.data.posed_image import Convention
from tests.badinputs.cases import HEIGHT, WIDTH, another, entry, frame, make_capture, opened, top


def renamed(names):
    """Gives the images other names."""

    def change(root, meta):
        for i, name in enumerate(names):
            another(i, f"{name}.jpg", (root / "images" / f"{i}.jpg").rename)(root, meta)

    return change


def test_frames_stream_in_natural_order(tmp_path):
    names = [frame.name for frame in opened(tmp_path, renamed(("10", "9", "2b", "2a"))).frames]
    assert names == ["images/2a.jpg", "images/2b.jpg", "images/9.jpg", "images/10.jpg"]


def test_a_frames_own_intrinsics_come_first(tmp_path):
    """One angle of view gives both focal lengths, two give one each; the other frames keep those of the file."""
    angle = 2 * np.arctan(0.5)
    capture = opened(
        tmp_path,
        frame(0, camera_angle_x=angle, fl_y=70.0, cx=10),
        frame(2, camera_angle_x=angle, camera_angle_y=angle),
        frame(3, camera_angle_x=angle),
    )
    for i, (fx, fy, cx) in enumerate([(WIDTH, 70, 10), (50, 51, 31), (WIDTH, HEIGHT, 31), (WIDTH, WIDTH, 31)]):
        np.testing.assert_allclose(capture.K(i), [[fx, 0, cx], [0, fy, 25], [0, 0, 1]], rtol=1e-14)


def test_blender_angles_and_missing_extensions_are_read(tmp_path):
    names = top(**dict.fromkeys(("fl_x", "fl_y", "cx", "cy", "w", "h")), camera_angle_x=2 * np.arctan(0.5))
    capture = opened(tmp_path, names, *(frame(i, file_path=f"images/{i}") for i in range(4)))
    wanted = [[WIDTH, 0, WIDTH / 2], [0, WIDTH, HEIGHT / 2], [0, 0, 1]]
    np.testing.assert_allclose(capture.K(0), wanted, rtol=1e-14)


def test_a_pose_almost_a_rotation_is_projected_and_reported(tmp_path):
    capture = opened(tmp_path, entry(0, 1, 5e-4))
    rotation = capture.frames[2].camtoworld[:3, :3]
    np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), rtol=0, atol=1e-14)
    assert np.abs(rotation - np.diag([1.0, -1, -1])).max() < 5e-4
    assert len(capture.notes) == 1 and "1 poses" in capture.notes[0]


@pytest.mark.parametrize("turned", [False, True], ids=["landscape", "portrait"])
def test_the_longer_side_determines_the_shrink_factor(tmp_path, turned):
    """1087 / 8 is rounded down to 135; the ratio of the short sides would be too inexact for the long side."""
    wanted, stored = ((1087, 1920), (135, 240)) if turned else ((1920, 1087), (240, 135))

    def describe(root, meta):
        for path in (root / "images").iterdir():
            Image.new("RGB", stored).save(path)
        meta.update(w=wanted[0], h=wanted[1], fl_x=1500.0, fl_y=1500.0, cx=wanted[0] / 2, cy=wanted[1] / 2)

    np.testing.assert_allclose(opened(tmp_path, describe).K(0)[[0, 1], [0, 1]], 1500 / 8)


def test_names_without_an_order_keep_the_order_of_the_file(tmp_path):
    """The camera path decides about the order for random names, or all left images before all right ones."""
    told = opened(tmp_path, renamed("cadb"))
    assert [frame.name[7] for frame in told.frames] == list("cadb")
    assert any("file's order" in note for note in told.notes)


def test_frames_are_ordered_by_poses_in_their_own_convention(tmp_path):
    """An orbit with random names: read as camera-to-world, all of it stands in one place."""
    names, written = "qcxamzbktrdyovfjsgpe", Convention("opengl", "world-to-camera")

    def change(root, meta):
        renamed(names)(root, meta)
        for i in range(len(names)):
            pose = np.eye(4)
            pose[:3, :3] = Rotation.from_euler("y", 18 * i, degrees=True).as_matrix()
            pose[:3, 3] = -3 * pose[:3, 2]
            meta["frames"][i]["transform_matrix"] = written.from_opencv(pose).tolist()

    root = make_capture(tmp_path / "c", change, num_frames=len(names))
    assert [frame.name[7] for frame in open_capture(f"{root}?poses=world-to-camera").frames] == list(names)
