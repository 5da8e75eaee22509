"""Axis conventions of readers: a camera written by hand in each format sees known points where it must.

The camera is at (1, 2, 3) and looks along the world's x axis, with the world's z axis up; its right is thus -y. Pixels
follow from that sentence alone, so a convention that a writer and a reader of these tests shared would be found.
"""

import json

import numpy as np
import pytest

from ssplat_jax.data.open_capture import open_capture
from tests.data.capture_writers import write_image

SIZE, FOCAL = (64, 48), 40.0
AHEAD, BELOW, RIGHT = (5.0, 2.0, 3.0), (5.0, 2.0, 2.0), (5.0, 1.0, 3.0)  # at depth 4
LOOK = {"fx": FOCAL, "fy": FOCAL, "cx": 32, "cy": 24, "width": 64, "height": 48}


def transforms(root):
    matrix = [[0, 0, -1, 1], [-1, 0, 0, 2], [0, 1, 0, 3], [0, 0, 0, 1]]  # columns: right, up, backward, center
    write_image(root / "nerfstudio" / "images" / "a.png", 0, SIZE)
    frame = {"file_path": "images/a.png", "transform_matrix": matrix}
    (root / "nerfstudio" / "transforms.json").write_text(json.dumps({"fl_x": FOCAL, "frames": [frame]}))


def splat_cameras(root):
    write_image(root / "images" / "a.png", 0, SIZE)
    entry = {"img_name": "a", "position": [1, 2, 3], "rotation": [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], **LOOK}
    (root / "cameras.json").write_text(json.dumps([entry]))


def polycam(root):
    for prefix in ("", "corrected_"):  # the corrected camera is read, the other one looks elsewhere
        write_image(root / "keyframes" / f"{prefix}images" / "9.jpg", 0, SIZE)
        (root / "keyframes" / f"{prefix}cameras").mkdir()
        rows = [[0, 0, -1, 1], [-1, 0, 0, 2], [0, 1, 0, 3]] if prefix else np.eye(4)[:3].tolist()
        fields = {f"t_{i}{j}": rows[i][j] for i in range(3) for j in range(4)}
        (root / "keyframes" / f"{prefix}cameras" / "9.json").write_text(json.dumps({**LOOK, **fields}))


def record3d(root):
    write_image(root / "rgbd" / "0.jpg", 0, SIZE)
    # The camera's x, y (up), z (backward) axes become -y, z, -x: a turn by 120 degrees about (1, -1, -1).
    meta = {"w": 64, "h": 48, "K": [FOCAL, 0, 0, 0, FOCAL, 0, 32, 24, 1], "poses": [[0.5, -0.5, -0.5, 0.5, 1, 2, 3]]}
    (root / "metadata").write_text(json.dumps(meta))


def llff(root):
    write_image(root / "images" / "a.png", 0, SIZE)
    # Columns: down, right, backward, center, (height, width, focal length).
    row = [0, 0, -1, 1, 48, 0, -1, 0, 2, 64, -1, 0, 0, 3, FOCAL, 1, 9]
    np.save(root / "poses_bounds.npy", np.array([row], float))


def kitti(root):
    """The odometry data set's own folders; camera 2 is half a meter to the right of camera 0, which has the pose."""
    sequence = root / "sequences" / "04"
    write_image(sequence / "image_2" / "000000.png", 0, SIZE)
    (sequence / "calib.txt").write_text(f"P2: {FOCAL} 0 31.5 {-0.5 * FOCAL} 0 {FOCAL} 23.5 0 0 0 1 0")
    (root / "poses").mkdir()
    (root / "poses" / "04.txt").write_text("0 0 1 1 -1 0 0 2.5 0 -1 0 3\n")
    return sequence


def colmap(root):
    write_image(root / "images" / "a.png", 0, SIZE)
    (root / "sparse" / "1").mkdir(parents=True)
    (root / "sparse" / "1" / "cameras.txt").write_text(f"1 SIMPLE_PINHOLE 64 48 {FOCAL} 32 24\n")
    (root / "sparse" / "1" / "images.txt").write_text("1 0.5 0.5 -0.5 0.5 2 3 -1 1 a.png\n\n")


@pytest.mark.parametrize("write", [transforms, splat_cameras, polycam, record3d, llff, kitti, colmap])
def test_a_camera_sees_points_where_its_axes_say(write, tmp_path):
    capture = open_capture(write(tmp_path) or tmp_path)
    viewmat = np.linalg.inv(capture.camtoworlds[0])
    points = np.array([AHEAD, BELOW, RIGHT]) @ viewmat[:3, :3].T + viewmat[:3, 3]
    np.testing.assert_allclose(points[:, 2], 4, atol=1e-9)
    pixels = points @ capture.K(0).T
    shift = FOCAL / 4  # one unit at depth 4
    wanted = [(32, 24), (32, 24 + shift), (32 + shift, 24)]
    np.testing.assert_allclose(pixels[:, :2] / pixels[:, 2:], wanted, atol=1e-9)
