"""Readers: one capture is the same in every format."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ssplat_jax.core.errors import InputError
from ssplat_jax.data.images import FisheyeLens
from ssplat_jax.data.open_capture import open_capture
from tests.badinputs.cases import HEIGHT, NUM_FRAMES, WIDTH
from tests.data.capture_writers import (
    COLMAP_IMAGES,
    CX,
    CY,
    FX,
    FY,
    WRITERS,
    K,
    camera_bytes,
    edit_text,
    poses,
    remove,
    tum_line,
    write_colmap_binary,
    write_colmap_text,
    write_depth,
    write_image,
)

NAMES = {  # in the order of streaming
    "COLMAP": ("9.jpg", "10.jpg", "b 0.jpg", "c/1.jpg"),
    "ScanNet": tuple(f"color/{i}.jpg" for i in range(9, 13)),
    "TUM RGB-D": tuple(f"rgb/{1305031102.25 + i / 30:.6f}.png" for i in range(4)),
    "RealEstate10K": tuple(str(90000 + 33367 * i) for i in range(4)),
    "cameras.json": tuple(f"frame_{i}" for i in range(4)),
    "Polycam": tuple(f"{7000 + i}.jpg" for i in range(4)),
    "Record3D": tuple(f"rgb/{i}.jpg" for i in range(4)),
    "LLFF": tuple(f"images/IMG_{i}.JPG" for i in range(4)),
    "KITTI": tuple(f"image_2/{i:06d}.png" for i in range(4)),
    "RealityCapture": tuple(f"{i}.jpg" for i in range(4)),
    "Metashape": tuple(map(str, range(4))),
}
INTRINSICS = {  # of formats that cannot hold K
    "cameras.json": [[FX, 0, WIDTH / 2], [0, FY, HEIGHT / 2], [0, 0, 1]],
    "LLFF": [[FX, 0, WIDTH / 2], [0, FX, HEIGHT / 2], [0, 0, 1]],
    "RealityCapture": [[FX, 0, CX], [0, FX, CY], [0, 0, 1]],
}
WITH_DEPTH = ("ScanNet", "TUM RGB-D", "Polycam")


def test_llff_images_have_the_poses_of_their_names_and_not_of_what_they_link_to(tmp_path):
    WRITERS["LLFF"](tmp_path)
    (tmp_path / "raw").mkdir()
    for i in range(NUM_FRAMES):
        image = tmp_path / "images" / f"IMG_{i}.JPG"
        image.rename(tmp_path / "raw" / f"{9 - i}.JPG")
        image.symlink_to(tmp_path / "raw" / f"{9 - i}.JPG")
    capture = open_capture(tmp_path)
    assert tuple(frame.name for frame in capture.frames) == NAMES["LLFF"]
    assert [frame.path.name for frame in capture.frames] == [f"{9 - i}.JPG" for i in range(NUM_FRAMES)]
    np.testing.assert_allclose(capture.camtoworlds, poses(), atol=1e-12)
    (tmp_path / "images" / "IMG_0.JPG").unlink()
    (tmp_path / "images" / "IMG_0.JPG").symlink_to(__file__)
    with pytest.raises(InputError, match=r"IMG_0\.JPG: wanted a path inside"):
        open_capture(tmp_path)


@pytest.mark.parametrize("kind", WRITERS)
def test_a_capture_is_the_same_in_every_format(kind, tmp_path):
    WRITERS[kind](tmp_path)
    capture = open_capture(tmp_path)
    assert capture.format == kind.removesuffix(" text")
    assert tuple(frame.name for frame in capture.frames) == NAMES[capture.format]
    order = [COLMAP_IMAGES.index(f.name) for f in capture.frames] if capture.format == "COLMAP" else range(NUM_FRAMES)
    np.testing.assert_allclose(capture.camtoworlds, poses()[list(order)], atol=2e-6 if "TUM" in kind else 1e-12)
    for i in range(NUM_FRAMES):
        np.testing.assert_allclose(capture.K(i), INTRINSICS.get(capture.format, K), rtol=1e-12)
        assert capture.frames[i].lens is None
        if capture.depth(i) is not None:
            np.testing.assert_allclose(capture.depth(i), 1.5, rtol=1e-6)
    assert capture.pixels.has_depth(0) == (capture.format in WITH_DEPTH)
    assert not [note for note in capture.notes if "1/5000" not in note]  # the unit of TUM's depth maps


@pytest.mark.parametrize("sparse", ["sparse", "colmap/sparse/0", ".", "sparse/1", "colmap/sparse/12"])
def test_a_colmap_model_is_found_in_its_usual_places(sparse, tmp_path):
    write_colmap_binary(tmp_path, sparse=sparse)
    assert len(open_capture(tmp_path)) == NUM_FRAMES


def test_colmap_cameras_that_no_image_uses_may_be_of_any_model(tmp_path):
    cameras = [camera_bytes(7, (FX, FY, CX, CY, 0.9), camera=5), camera_bytes(1, (FX, FY, CX, CY))]
    write_colmap_binary(tmp_path / "binary", [*cameras, camera_bytes(17, (WIDTH, HEIGHT), camera=8)])
    text = f"5 FOV {WIDTH} {HEIGHT} {FX} {FY} {CX} {CY} 0.9\n1 PINHOLE {WIDTH} {HEIGHT} {FX} {FY} {CX} {CY}\n8 NEW 1 1"
    write_colmap_text(tmp_path / "text", camera=text)
    for root in ("binary", "text"):
        np.testing.assert_array_equal(open_capture(tmp_path / root).frames[0].K, K)


LENS, DENOMINATOR = (0.11, 0.02, 0.01, 0.03), (0.04, 0.1, -0.05, 0.02)
MODELS = (
    (0, "SIMPLE_PINHOLE", (FX, CX, CY), ""),
    (1, "PINHOLE", (FX, FY, CX, CY), ""),
    (2, "SIMPLE_RADIAL", (FX, CX, CY, 0.11), "k1"),
    (3, "RADIAL", (FX, CX, CY, 0.11, 0.02), "k1 k2"),
    (4, "OPENCV", (FX, FY, CX, CY, *LENS), "k1 k2 p1 p2"),
    (5, "OPENCV_FISHEYE", (FX, FY, CX, CY, *LENS), "k1 k2 k3 k4"),
    (6, "FULL_OPENCV", (FX, FY, CX, CY, *LENS, *DENOMINATOR), "k1 k2 p1 p2 k3 d1 d2 d3"),
    (8, "SIMPLE_RADIAL_FISHEYE", (FX, CX, CY, 0.11), "k1"),
    (9, "RADIAL_FISHEYE", (FX, CX, CY, 0.11, 0.02), "k1 k2"),
    (15, "FISHEYE", (FX, FY, CX, CY), ""),
)


@pytest.mark.parametrize(("model", "name", "params", "coefficients"), MODELS)
def test_colmap_camera_models_give_their_intrinsics(model, name, params, coefficients, tmp_path):
    write_colmap_binary(tmp_path / "binary", [camera_bytes(model, params)])
    text = f"1 {name} {WIDTH} {HEIGHT} " + " ".join(map(str, params))
    write_colmap_text(tmp_path / "text", camera=text)
    for root in ("binary", "text"):
        frame = open_capture(tmp_path / root).frames[0]
        assert (frame.K[0, 0], frame.K[1, 1]) == (FX, FX if params[1] == CX else FY)
        assert (frame.K[0, 2], frame.K[1, 2]) == (CX, CY)
        found = {} if frame.lens is None else {k: v for k, v in vars(frame.lens).items() if v}
        assert found == dict(zip(coefficients.split(), (*LENS, *DENOMINATOR), strict=False))
        assert isinstance(frame.lens, FisheyeLens) == ("FISHEYE" in name)


def test_tum_poses_are_interpolated_in_time(tmp_path):
    """On a screw motion, interpolated poses agree with the motion at all times."""
    WRITERS["TUM RGB-D"](tmp_path)
    start, spin, speed = 1305031102.2, np.array([0.3, -0.8, 0.5]), np.array([0.4, 0.1, -0.2])  # rad/s, m/s

    def pose(time):
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.from_rotvec(spin * (time - start)).as_matrix()
        matrix[:3, 3] = speed * (time - start)
        return matrix

    samples = [start + 0.05 * i for i in range(6)]
    # A quaternion and its negative are the same rotation.
    lines = [tum_line(time, pose(time)) for time in samples]
    words = lines[3].split()
    lines[3] = " ".join([*words[:4], *(str(-float(w)) for w in words[4:])])
    (tmp_path / "groundtruth.txt").write_text("\n".join(lines))
    capture = open_capture(tmp_path)
    wanted = [pose(1305031102.25 + i / 30) for i in range(NUM_FRAMES)]
    # Linear interpolation over 0.05 s at 1 rad/s is off by some 1e-6 rad; times in the file are rounded to 1e-4 s.
    np.testing.assert_allclose(capture.camtoworlds, wanted, atol=1e-5)


def test_tum_depth_maps_are_those_nearest_in_time(tmp_path):
    WRITERS["TUM RGB-D"](tmp_path)
    lines = (tmp_path / "depth.txt").read_text().splitlines()
    before = [f"{float(line.split()[0]) - 0.013:.6f} depth/before{i}.png" for i, line in enumerate(lines)]
    after = [f"{float(line.split()[0]) + 0.004:.6f} depth/after{i}.png" for i, line in enumerate(lines)]
    for i in range(len(lines)):
        write_depth(tmp_path / "depth" / f"before{i}.png", 100)
        write_depth(tmp_path / "depth" / f"after{i}.png", 200)
    (tmp_path / "depth.txt").write_text("\n".join([*after, *lines, *before]))
    chosen = [frame.depth_path.name for frame in open_capture(tmp_path).frames]
    assert chosen == [f"before{i}.png" for i in range(len(lines))]  # 3 ms away; the others 10 and 14


def test_record3d_images_may_have_intrinsics_of_their_own(tmp_path):
    WRITERS["Record3D"](tmp_path)
    file = tmp_path / "metadata.json"
    meta = json.loads(file.read_text())
    rows = [[FX + i, FY - i, CX + 0.5 * i, CY - 0.25 * i] for i in range(NUM_FRAMES)]
    file.write_text(json.dumps(meta | {"perFrameIntrinsicCoeffs": rows}))
    capture = open_capture(tmp_path)
    for i, (fx, fy, cx, cy) in enumerate(rows):
        np.testing.assert_array_equal(capture.K(i), [[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    file.write_text(json.dumps(meta | {"perFrameIntrinsicCoeffs": rows[1:]}))
    with pytest.raises(InputError, match="perFrameIntrinsicCoeffs: wanted 4 x 4 finite numbers"):
        open_capture(tmp_path)


def leave_one_image(root, model):
    edit_text(f"{model}/images.txt", lambda text: "\n".join(text.split("\n")[:4]) + "\n")(root)  # two lines an image


def test_a_larger_colmap_model_beside_the_one_that_is_read_is_named(tmp_path):
    write_colmap_text(tmp_path)
    write_colmap_text(tmp_path, sparse="sparse/1")
    leave_one_image(tmp_path, "sparse/0")
    capture = open_capture(tmp_path)
    assert len(capture) == 1
    assert capture.notes == (
        "3 images in images/ are left out: COLMAP did not register them.",
        "sparse/1 holds 4 images; sparse/0, which is read, holds 1. Swap the folders' names to read the larger one.",
    )
    (tmp_path / "sparse" / "1").rename(tmp_path / "sparse" / "1_old")  # never read, whatever it holds
    assert len(open_capture(tmp_path).notes) == 1
    (tmp_path / "sparse" / "1_old").rename(tmp_path / "sparse" / "1")
    leave_one_image(tmp_path, "sparse/1")  # as many
    assert len(open_capture(tmp_path).notes) == 1


def test_a_capture_with_a_number_for_a_name_has_no_others_beside_it(tmp_path):
    write_colmap_text(tmp_path / "24", sparse=".")
    write_colmap_text(tmp_path / "25", sparse=".")
    leave_one_image(tmp_path, "24")
    assert len(open_capture(tmp_path / "24")) == 1


def untracked(root):
    (root / "pose" / "10.txt").write_text("-inf -inf -inf -inf\n" * 4)
    (root / "pose" / "12.txt").unlink()


def few_poses(root):
    lines = (root / "groundtruth.txt").read_text().splitlines()
    (root / "groundtruth.txt").write_text("\n".join([*sorted(lines[1:])[:2], "1305031103.000000 0 0 0 0 0 0 1"]))


@pytest.mark.parametrize(
    ("kind", "spoil", "kept", "note"),
    [
        ("COLMAP", remove("images/9.jpg"), (1, 2, 3), "1 of 4 frames are skipped: their file is missing."),
        ("ScanNet", untracked, (0, 2), "2 of 4 frames are skipped: their finite pose is missing."),
        ("TUM RGB-D", few_poses, (0, 1), "2 of 4 frames are skipped: their pose at their time is missing."),
        ("Polycam", remove("keyframes/cameras/7001.json"), (0, 2, 3), "1 of 4 frames are skipped"),
        ("Record3D", remove("rgb/0.jpg"), (1, 2, 3), "1 of 4 frames are skipped"),
        ("RealEstate10K", remove("0a1b/90000.png"), (1, 2, 3), "1 of 4 frames are skipped"),
        ("TUM RGB-D", remove("depth/*"), (0, 1, 2, 3), "4 files of depth.txt are missing"),
    ],
)
def test_frames_without_a_pose_or_image_are_left_out_and_counted(kind, spoil, kept, note, tmp_path):
    WRITERS[kind](tmp_path)
    spoil(tmp_path)
    capture = open_capture(tmp_path)
    assert tuple(frame.name for frame in capture.frames) == tuple(NAMES[kind][i] for i in kept)
    notes = [note for note in capture.notes if "1/5000" not in note]  # the unit of TUM's depth maps
    assert len(notes) == 1 and notes[0].startswith(note)


@pytest.mark.parametrize("kind", ["COLMAP", "cameras.json", "LLFF"])
def test_shrunk_images_stand_in_for_missing_ones(kind, tmp_path):
    """Also with another extension; their intrinsics shrink with them."""
    WRITERS[kind](tmp_path)
    whole = open_capture(tmp_path).K(0)
    for i, file in enumerate(sorted(file for file in (tmp_path / "images").rglob("*") if file.is_file())):
        name = file.relative_to(tmp_path / "images").with_suffix(".png")
        write_image(tmp_path / "images_2" / name, i, (WIDTH // 2, HEIGHT // 2))
    (tmp_path / "images").rename(tmp_path / "elsewhere")
    shrunk = open_capture(tmp_path)
    np.testing.assert_allclose(shrunk.K(0)[:2], whole[:2] / 2, rtol=1e-12)
    assert "0.5 times" in shrunk.notes[0]


# -- axes -------------------------------------------------------------------------------------------------------------
# A camera written by hand in each format sees known points where it must. It is at (1, 2, 3) and looks along the
# world's x axis, with the world's z axis up; its right is thus -y. Pixels follow from that sentence alone, so a
# convention that the writers and readers shared would be found.

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


def reality_capture(root):
    """A level camera (roll 0) that looks at the horizon has pitch 90, and heading 0 looks along +y."""
    write_image(root / "images" / "a.png", 0, SIZE)
    row = f"a.png,1,2,3,90,90,0,{FOCAL * 36 / 64},0,0,0,0,0,0,0,0"
    (root / "cameras.csv").write_text(f"#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\r\n{row}")


@pytest.mark.parametrize("write", [transforms, splat_cameras, polycam, record3d, llff, kitti, colmap, reality_capture])
def test_a_camera_sees_points_where_its_axes_say(write, tmp_path):
    capture = open_capture(write(tmp_path) or tmp_path)
    viewmat = np.linalg.inv(capture.camtoworlds[0])
    points = np.array([AHEAD, BELOW, RIGHT]) @ viewmat[:3, :3].T + viewmat[:3, 3]
    np.testing.assert_allclose(points[:, 2], 4, atol=1e-9)
    pixels = points @ capture.K(0).T
    shift = FOCAL / 4  # one unit at depth 4
    wanted = [(32, 24), (32, 24 + shift), (32 + shift, 24)]
    np.testing.assert_allclose(pixels[:, :2] / pixels[:, 2:], wanted, atol=1e-9)
