"""One capture written in every format is the same capture; what is wrong in a file is refused in one line.

Rotations are checked against SciPy's, which the readers do not use.
"""

import random
import struct

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from ssplat_jax.data.capture import open_capture
from ssplat_jax.errors import InputError
from tests.badinputs.test_badinputs import mutant

WIDTH, HEIGHT, NUM_FRAMES = 64, 48, 4
FX, FY, CX, CY = 50.0, 51.0, 31.0, 25.0
K = np.array([[FX, 0, CX], [0, FY, CY], [0, 0, 1]])
NUM_MUTANTS = 150
COLMAP_IMAGES = ("b 0.jpg", "9.jpg", "10.jpg", "c/1.jpg")  # spaces, folders and numbers, in no order
IDS = (7, 3, 900, 12)


def poses():
    """Camera-to-world matrices of a turning camera on its way."""
    rotations = Rotation.from_rotvec([[0.1 * i, 0.2 - 0.1 * i, 0.05] for i in range(NUM_FRAMES)])
    matrices = np.tile(np.eye(4), (NUM_FRAMES, 1, 1))
    matrices[:, :3, :3] = rotations.as_matrix()
    matrices[:, :3, 3] = [[0.1 * i, 0.02 * i * i, 0.3] for i in range(NUM_FRAMES)]
    return matrices


def write_image(path, i=0, size=(WIDTH, HEIGHT)):
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.random.default_rng(i).integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)
    Image.fromarray(pixels).save(path)


def write_depth(path, value):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.full((HEIGHT // 2, WIDTH // 2), value, np.uint16)).save(path)


def colmap_pose(i):
    """(quaternion wxyz, translation) of the world-to-camera transform."""
    worldtocam = np.linalg.inv(poses()[i])
    x, y, z, w = Rotation.from_matrix(worldtocam[:3, :3]).as_quat()
    return (w, x, y, z), tuple(worldtocam[:3, 3])


def write_colmap_images(root, folder="images", size=(WIDTH, HEIGHT)):
    for i, name in enumerate(COLMAP_IMAGES):
        write_image(root / folder / name, i, size)


def write_colmap_text(root, *, camera=f"1 PINHOLE {WIDTH} {HEIGHT} {FX} {FY} {CX} {CY}", sparse="sparse/0"):
    write_colmap_images(root)
    (root / sparse).mkdir(parents=True, exist_ok=True)
    (root / sparse / "cameras.txt").write_text(f"# a comment\n{camera}\n")
    lines = ["# IMAGE_ID, QW ...", "# POINTS2D"]
    for i in (2, 0, 3, 1):
        quat, translation = colmap_pose(i)
        # Two pixels and the point that one of them shows; of one image none.
        points = "1.5 2.5 -1 3.5 4.5 17" if i else ""
        pose = " ".join(repr(float(x)) for x in (*quat, *translation))
        lines += [f"{IDS[i]} {pose} 1 {COLMAP_IMAGES[i]}", points]
    (root / sparse / "images.txt").write_text("\n".join(lines) + "\n")


def camera_bytes(model, params, camera=1, size=(WIDTH, HEIGHT)):
    return struct.pack(f"<IiQQ{len(params)}d", camera, model, *size, *params)


def write_colmap_binary(root, cameras=None, sparse="sparse/0"):
    write_colmap_images(root)
    (root / sparse).mkdir(parents=True, exist_ok=True)
    cameras = [camera_bytes(1, (FX, FY, CX, CY))] if cameras is None else cameras
    (root / sparse / "cameras.bin").write_bytes(struct.pack("<Q", len(cameras)) + b"".join(cameras))
    data = struct.pack("<Q", NUM_FRAMES)
    for i in (2, 0, 3, 1):
        quat, translation = colmap_pose(i)
        data += struct.pack("<I7dI", IDS[i], *quat, *translation, 1) + COLMAP_IMAGES[i].encode() + b"\0"
        data += struct.pack("<Q", i) + i * struct.pack("<ddq", 1.5, 2.5, -1)
    (root / sparse / "images.bin").write_bytes(data)


def matrix_text(matrix):
    return "\n".join(" ".join(repr(float(x)) for x in row) for row in matrix) + "\n"


def write_scannet(root):
    for i, pose in enumerate(poses()):
        write_image(root / "color" / f"{9 + i}.jpg", i)
        write_depth(root / "depth" / f"{9 + i}.png", 1500)
        (root / "pose").mkdir(exist_ok=True)
        (root / "pose" / f"{9 + i}.txt").write_text(matrix_text(pose))
    (root / "intrinsic").mkdir()
    intrinsics = np.eye(4)
    intrinsics[:3, :3] = K
    (root / "intrinsic" / "intrinsic_color.txt").write_text(matrix_text(intrinsics))


def tum_line(time, pose):
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return f"{time:.4f} " + " ".join(repr(float(v)) for v in (*pose[:3, 3], x, y, z, w))


def write_tum(root):
    images, depths, truth = ["# color images"], [], ["# ground truth"]
    for i, pose in enumerate(poses()):
        time = 1305031102.25 + i / 30
        write_image(root / "rgb" / f"{time:.6f}.png", i)
        write_depth(root / "depth" / f"{i}.png", 7500)
        images.append(f"{time:.6f} rgb/{time:.6f}.png")
        depths.append(f"{time + 0.01:.6f} depth/{i}.png")
        truth.append(f"{time:.6f} " + tum_line(0, pose).split(maxsplit=1)[1])
    truth[2:4] = truth[3:1:-1]  # unsorted
    (root / "rgb.txt").write_text("\n".join(images))
    (root / "depth.txt").write_text("\n".join(depths))
    (root / "groundtruth.txt").write_text("\n".join(truth))
    (root / "calibration.txt").write_text(f"{FX} {FY} {CX - 0.5} {CY - 0.5}\n")


def write_realestate(root):
    lines = ["https://www.youtube.com/watch?v=0123456789a"]
    for i, pose in enumerate(poses()):
        write_image(root / "0a1b" / f"{90000 + 33367 * i}.png", i)
        row = (FX / WIDTH, FY / HEIGHT, CX / WIDTH, CY / HEIGHT, 0, 0, *np.linalg.inv(pose)[:3].reshape(-1))
        lines.append(f"{90000 + 33367 * i} " + " ".join(repr(float(x)) for x in row))
    (root / "0a1b.txt").write_text("\n".join(lines))


WRITERS = {
    "COLMAP": write_colmap_binary,
    "COLMAP text": write_colmap_text,
    "ScanNet": write_scannet,
    "TUM RGB-D": write_tum,
    "RealEstate10K": write_realestate,
}
NAMES = {  # in the order of streaming
    "COLMAP": ("9.jpg", "10.jpg", "b 0.jpg", "c/1.jpg"),
    "ScanNet": tuple(f"color/{i}.jpg" for i in range(9, 13)),
    "TUM RGB-D": tuple(f"rgb/{1305031102.25 + i / 30:.6f}.png" for i in range(4)),
    "RealEstate10K": tuple(str(90000 + 33367 * i) for i in range(4)),
}


@pytest.mark.parametrize("kind", WRITERS)
def test_a_capture_is_the_same_in_every_format(kind, tmp_path):
    WRITERS[kind](tmp_path)
    capture = open_capture(tmp_path)
    capture.verify()
    assert capture.format == kind.removesuffix(" text")
    assert tuple(frame.name for frame in capture.frames) == NAMES[capture.format]
    order = [COLMAP_IMAGES.index(f.name) for f in capture.frames] if capture.format == "COLMAP" else range(NUM_FRAMES)
    np.testing.assert_allclose(capture.camtoworlds, poses()[list(order)], atol=2e-6 if "TUM" in kind else 1e-12)
    for i in range(NUM_FRAMES):
        np.testing.assert_allclose(capture.K(i), K, rtol=1e-12)
        assert capture.frames[i].lens is None
        if capture.depth(i) is not None:
            np.testing.assert_allclose(capture.depth(i), 1.5, rtol=1e-6)
    assert capture.pixels.has_depth(0) == (capture.format in ("ScanNet", "TUM RGB-D"))
    assert capture.notes == ()


@pytest.mark.parametrize("sparse", ["sparse", "colmap/sparse/0", "."])
def test_a_reconstruction_is_found_in_its_usual_places(sparse, tmp_path):
    write_colmap_binary(tmp_path, sparse=sparse)
    assert len(open_capture(tmp_path)) == NUM_FRAMES


def test_binary_files_come_before_text(tmp_path):
    write_colmap_binary(tmp_path)
    (tmp_path / "sparse" / "0" / "cameras.txt").write_text("nonsense")
    (tmp_path / "sparse" / "0" / "images.txt").write_text("nonsense")
    assert len(open_capture(tmp_path)) == NUM_FRAMES


def test_images_of_a_reconstruction_may_lie_in_its_folder_or_be_shrunk(tmp_path):
    write_colmap_binary(tmp_path / "beside")
    for name in COLMAP_IMAGES:
        (tmp_path / "beside" / name).parent.mkdir(exist_ok=True)
        (tmp_path / "beside" / "images" / name).rename(tmp_path / "beside" / name)
    (tmp_path / "beside" / "images" / "c").rmdir()
    (tmp_path / "beside" / "images").rmdir()
    assert open_capture(tmp_path / "beside").frames[0].path == tmp_path / "beside" / "9.jpg"
    write_colmap_binary(tmp_path / "shrunk")
    (tmp_path / "shrunk" / "images").rename(tmp_path / "full")
    write_colmap_images(tmp_path / "shrunk", "images_2", (WIDTH // 2, HEIGHT // 2))
    shrunk = open_capture(tmp_path / "shrunk")
    np.testing.assert_allclose(shrunk.K(0)[:2], K[:2] / 2)
    assert "0.5 times" in shrunk.notes[0]


@pytest.mark.parametrize(
    ("model", "name", "params", "wanted"),
    [
        (0, "SIMPLE_PINHOLE", (FX, CX, CY), {}),
        (1, "PINHOLE", (FX, FY, CX, CY), {}),
        (2, "SIMPLE_RADIAL", (FX, CX, CY, 0.11), {"k1": 0.11}),
        (3, "RADIAL", (FX, CX, CY, 0.11, 0.02), {"k1": 0.11, "k2": 0.02}),
        (4, "OPENCV", (FX, FY, CX, CY, 0.11, 0.02, 0.01, 0.03), {"k1": 0.11, "k2": 0.02, "p1": 0.01, "p2": 0.03}),
        (
            6,
            "FULL_OPENCV",
            (FX, FY, CX, CY, 0.11, 0.02, 0.01, 0.03, 0.04, 0, 0, 0),
            {"k1": 0.11, "k2": 0.02, "p1": 0.01, "p2": 0.03, "k3": 0.04},
        ),
    ],
)
def test_camera_models_are_told_apart(model, name, params, wanted, tmp_path):
    write_colmap_binary(tmp_path / "binary", [camera_bytes(model, params)])
    text = f"1 {name} {WIDTH} {HEIGHT} " + " ".join(map(str, params))
    write_colmap_text(tmp_path / "text", camera=text)
    for root in ("binary", "text"):
        frame = open_capture(tmp_path / root).frames[0]
        assert (frame.K[0, 0], frame.K[1, 1]) == (FX, FX if params[1] == CX else FY)
        assert (frame.K[0, 2], frame.K[1, 2]) == (CX, CY)
        found = {} if frame.lens is None else {k: v for k, v in vars(frame.lens).items() if v}
        assert found == wanted


def test_scannet_lost_tracking_is_left_out_and_counted(tmp_path):
    write_scannet(tmp_path)
    (tmp_path / "pose" / "10.txt").write_text("-inf -inf -inf -inf\n" * 4)
    (tmp_path / "pose" / "12.txt").unlink()
    capture = open_capture(tmp_path)
    assert [frame.name for frame in capture.frames] == ["color/9.jpg", "color/11.jpg"]
    assert "2 of 4 frames" in capture.notes[0]


def test_poses_of_tum_are_interpolated_in_time(tmp_path):
    """A steady screw: at every time, half-way between samples too, the pose is that of the motion."""
    write_tum(tmp_path)
    start, spin, speed = 1305031102.2, np.array([0.3, -0.8, 0.5]), np.array([0.4, 0.1, -0.2])  # rad/s, m/s

    def pose(time):
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.from_rotvec(spin * (time - start)).as_matrix()
        matrix[:3, 3] = speed * (time - start)
        return matrix

    samples = [start + 0.05 * i for i in range(6)]
    # A quaternion and its negative are one rotation.
    lines = [tum_line(time, pose(time)) for time in samples]
    words = lines[3].split()
    lines[3] = " ".join([*words[:4], *(str(-float(w)) for w in words[4:])])
    (tmp_path / "groundtruth.txt").write_text("\n".join(lines))
    capture = open_capture(tmp_path)
    wanted = [pose(1305031102.25 + i / 30) for i in range(NUM_FRAMES)]
    # Along the chord of 0.05 s of 1 rad/s instead of the arc: some 1e-6 rad; times are told to 1e-4 s.
    np.testing.assert_allclose(capture.camtoworlds, wanted, atol=1e-5)


def test_images_of_tum_stream_in_order_of_time_whatever_they_are_called(tmp_path):
    """0.4, 0.4333, 0.4666, 0.5: as names with numbers in them, 0.4 and 0.5 come before 0.4333."""
    write_tum(tmp_path)
    names = [f"rgb/1305031102.{digits}.png" for digits in ("4", "4333", "4666", "5")]
    lines = (tmp_path / "rgb.txt").read_text().splitlines()[1:]
    for line, name in zip(lines, names, strict=True):
        (tmp_path / line.split()[1]).rename(tmp_path / name)
    renamed = [f"{line.split()[0]} {name}" for line, name in zip(lines, names, strict=True)]
    (tmp_path / "rgb.txt").write_text("\n".join(reversed(renamed)))
    assert [frame.name for frame in open_capture(tmp_path).frames] == names


def test_names_of_a_reconstruction_may_begin_with_its_image_folder(tmp_path, monkeypatch):
    monkeypatch.setattr("tests.data.test_readers.COLMAP_IMAGES", tuple(f"images/{name}" for name in COLMAP_IMAGES))
    write_colmap_text(tmp_path)
    for path in sorted((tmp_path / "images" / "images").iterdir()):
        path.rename(tmp_path / "images" / path.name)
    (tmp_path / "images" / "images").rmdir()
    assert len(open_capture(tmp_path).frames) == NUM_FRAMES


def test_images_of_tum_without_poses_near_in_time_are_left_out(tmp_path):
    write_tum(tmp_path)
    lines = (tmp_path / "groundtruth.txt").read_text().splitlines()
    kept = sorted(lines[1:])[:2]
    late = "1305031103.000000 0 0 0 0 0 0 1"
    (tmp_path / "groundtruth.txt").write_text("\n".join([*kept, late]))
    capture = open_capture(tmp_path)
    assert len(capture) == 2 and "2 of 4 frames" in capture.notes[0]


def test_the_calibration_of_tum_is_known_by_the_folders_name(tmp_path):
    root = tmp_path / "rgbd_dataset_freiburg1_desk"
    write_tum(root)
    (root / "calibration.txt").unlink()
    for i in range(NUM_FRAMES):
        time = 1305031102.25 + i / 30
        write_image(root / "rgb" / f"{time:.6f}.png", i, (640, 480))
    frame = open_capture(root).frames[0]
    np.testing.assert_allclose(frame.K, [[517.3, 0, 319.1], [0, 516.5, 255.8], [0, 0, 1]])
    assert frame.lens is not None and (frame.lens.k1, frame.lens.p1, frame.lens.k3) == (0.2624, -0.0054, 1.1633)


def test_realestate_frames_without_images_are_left_out(tmp_path):
    write_realestate(tmp_path)
    (tmp_path / "0a1b" / "90000.png").unlink()
    capture = open_capture(tmp_path / "0a1b.txt")
    assert len(capture) == 3 and "1 of 4 frames" in capture.notes[0] and capture.name == "0a1b"


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


def camera(model, params):
    return write("sparse/0/cameras.bin", struct.pack("<Q", 1) + camera_bytes(model, params))


BAD = {
    # COLMAP, binary
    "no cameras.bin": ("COLMAP", remove("sparse/0/cameras.bin"), ("cameras.bin", "readable")),
    "images.bin empty": ("COLMAP", write("sparse/0/images.bin", b""), ("images.bin", "end of the file")),
    "images.bin cut": ("COLMAP", cut("sparse/0/images.bin", 5), ("images.bin",)),
    "images.bin counts 2^63": ("COLMAP", write("sparse/0/images.bin", struct.pack("<Q", 1 << 63)), ("9223372036",)),
    "no image registered": ("COLMAP", write("sparse/0/images.bin", struct.pack("<Q", 0)), ("registered",)),
    "fish-eye": ("COLMAP", camera(5, (FX, FY, CX, CY, 0, 0, 0, 0)), ("OPENCV_FISHEYE", "image_undistorter")),
    "model to come": ("COLMAP", camera(77, ()), ("model 77", "image_undistorter")),
    "denominator": ("COLMAP", camera(6, (FX, FY, CX, CY, 0, 0, 0, 0, 0, 0.1, 0, 0)), ("FULL_OPENCV", "k4")),
    "focal length 0": ("COLMAP", camera(0, (0, CX, CY)), ("camera 1", "focal length")),
    "lens that folds": ("COLMAP", camera(2, (FX, CX, CY, -9.0)), ("fold", "k1=-9")),
    "other camera": (
        "COLMAP",
        write("sparse/0/cameras.bin", struct.pack("<Q", 1) + camera_bytes(1, (FX, FY, CX, CY), camera=2)),
        ("camera 1, which is not there",),
    ),
    "image missing": ("COLMAP", remove("images/9.jpg"), ("9.jpg", "does not exist")),
    "image of another size": (
        "COLMAP",
        lambda root: write_image(root / "images" / "9.jpg", 0, (WIDTH, WIDTH)),
        ("64x48", "64x64", "that COLMAP saw"),
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
    "other times": ("TUM RGB-D", write("groundtruth.txt", b"1 0 0 0 0 0 0 1\n"), ("none at one time",)),
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
    assert num_refused > NUM_MUTANTS // 20  # the mutants do reach the checks
