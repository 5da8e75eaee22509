"""Files as people bring them: fields that change a camera, odd names, links, hidden files, other programs' cameras."""

import struct
import warnings

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from ssplat_jax.core.errors import InputError
from ssplat_jax.data.images import FisheyeLens, Lens
from ssplat_jax.data.open_capture import open_capture
from tests.badinputs.cases import HEIGHT, NUM_FRAMES, WIDTH, another, depth_map, frame, make_capture, opened, top
from tests.data.capture_writers import (
    COLMAP_IMAGES,
    WRITERS,
    K,
    camera_bytes,
    edit_json,
    edit_text,
    matrix_text,
    metashape_xml,
    write_colmap_binary,
    write_colmap_text,
    write_image,
    write_tum,
)

# -- fields of transforms.json ----------------------------------------------------------------------------------------

PARAMS = [0.1, -0.02, 0.003, 0.0004, 0.005, -0.006]  # k1 k2 k3 k4 p1 p2


def test_distortion_params_are_a_lens_of_the_file_or_of_a_frame(tmp_path):
    """Coefficients of a frame come before the list of the file."""
    change = frame(2, distortion_params=[0.2, 0, 0, 0, 0, 0]), frame(3, k1=0.2)
    frames = opened(tmp_path / "a", top(distortion_params=PARAMS), *change).frames
    assert frames[1].lens == Lens(k1=0.1, k2=-0.02, k3=0.003, k4=0.0004, p1=0.005, p2=-0.006)
    assert frames[2].lens == frames[3].lens == Lens(k1=0.2)
    plain = dict(zip(("k1", "k2", "k3", "k4", "p1", "p2"), PARAMS, strict=True))
    assert opened(tmp_path / "b", top(**plain)).frames[1].lens == frames[1].lens
    fish = top(camera_model="OPENCV_FISHEYE", distortion_params=[0.1, 0.01, 0, 0, 0, 0])
    assert opened(tmp_path / "c", fish).frames[0].lens == FisheyeLens(k1=0.1, k2=0.01)


def test_the_denominator_of_full_opencv_is_that_of_opencv(tmp_path):
    """Worked by hand for (0.5, -0.3): r^2 = 0.34, so that the numerator is 1.068."""
    lens = Lens(k1=0.2, d1=0.1, d2=-0.05, d3=0.02)
    wanted = 1.068 / (1 + 0.1 * 0.34 - 0.05 * 0.34**2 + 0.02 * 0.34**3)
    np.testing.assert_allclose(lens.distorted(np.array([0.5, -0.3])), wanted * np.array([0.5, -0.3]), rtol=1e-12)
    params = (50.0, 51.0, 31.0, 25.0, 0.2, 0, 0, 0, 0, 0.1, -0.05, 0.02)
    write_colmap_binary(tmp_path / "colmap", [camera_bytes(6, params)])
    assert open_capture(tmp_path / "colmap").frames[0].lens == lens
    fields = top(camera_model="FULL_OPENCV", k1=0.2, k4=0.1, k5=-0.05, k6=0.02)
    assert opened(tmp_path, fields).frames[0].lens == lens


@pytest.mark.parametrize("kind", ["depth_file_path", "depth_path"])
@pytest.mark.parametrize(
    ("fields", "unit"),
    [({}, 0.001), ({"integer_depth_scale": 10 / 65535}, 10 / 65535), ({"applied_scale": 0.25}, 0.00025)],
)
def test_depth_maps_have_the_unit_that_the_file_says(fields, unit, kind, tmp_path):
    depth = opened(tmp_path, top(**fields), depth_map(2, 19660, **{"depth_file_path": None, kind: "d.png"})).depth(2)
    np.testing.assert_allclose(depth, 19660 * unit, rtol=1e-6)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"k5": 0.1}, "k5"),
        ({"s1": 0.01}, "s1"),
        ({"xi": 1.2}, "xi"),
        ({"distortion_params": [0.1, 0.2]}, "distortion_params: wanted 6"),
        ({"camera_model": "EQUIRECTANGULAR"}, "cut them into perspective views"),
        ({"camera_model": "FISHEYE624"}, "undistort"),
        ({"equirectangular": True}, "equirectangular"),
        ({"latlong": True}, "latlong"),
        ({"orthographic": True}, "orthographic"),
        ({"ftheta_p1": 0.2}, "ftheta_p1"),
        ({"camera_model": "FULL_OPENCV", "s1": 0.1}, "s1"),
    ],
)
def test_lenses_that_are_not_modelled_are_refused_by_name(fields, words, tmp_path):
    with pytest.raises(InputError, match=words):
        opened(tmp_path, top(**fields))


def test_a_depth_unit_of_two_meanings_is_refused(tmp_path):
    with pytest.raises(InputError, match="depth_scale: wanted integer_depth_scale"):
        opened(tmp_path, depth_map(2, 1, depth_scale=1000))


def test_bad_frames_are_left_out(tmp_path):
    capture = opened(tmp_path, frame(1, is_bad=True), frame(2, is_bad=False))
    assert [frame.name for frame in capture.frames] == ["images/0.jpg", "images/2.jpg", "images/3.jpg"]
    assert "is_bad" in capture.notes[0]


def test_a_folder_of_splits_opens_with_its_training_split(tmp_path):
    root = make_capture(tmp_path / "c")
    (root / "transforms.json").rename(root / "transforms_train.json")
    capture = open_capture(root)
    assert len(capture) == NUM_FRAMES and "transforms_train.json" in capture.notes[0]


# -- fields and matrices of other formats ------------------------------------------------------------------------------


def with_skew(text):
    return text.replace("50.0 0.0 31.0", "50.0 5.0 31.0").replace("50.0 0.0 30.5", "50.0 5.0 30.5")


def with_k5(text):
    return "\n".join(line + (",0.3" if i else ",k5") for i, line in enumerate(text.split("\n")))


@pytest.mark.parametrize(
    ("kind", "change", "words"),
    [
        ("ScanNet", edit_text("intrinsic/intrinsic_color.txt", with_skew), "without skew"),
        ("KITTI", edit_text("calib.txt", with_skew), "without skew"),
        ("Record3D", edit_json("metadata.json", K=[50, 0, 0, 5, 51, 0, 31, 25, 1]), "without skew"),
        ("cameras.json", edit_json("cameras.json", k1=0.2), r"\[0\]\.k1"),
        ("Polycam", edit_json("keyframes/cameras/7001.json", distortion=[0.1, 0, 0, 0]), "distortion"),
        ("Metashape", edit_text("cameras.xml", lambda text: text.replace("<b1>", "<p3>1</p3><b1>")), "p3"),
        ("RealityCapture", edit_text("cameras.csv", with_k5), "k5"),
    ],
)
def test_what_no_pinhole_camera_or_lens_of_ours_has_is_refused(kind, change, words, tmp_path):
    WRITERS[kind](tmp_path)
    change(tmp_path)
    with pytest.raises(InputError, match=words):
        open_capture(tmp_path)


def test_the_principal_point_of_a_cameras_json_counts(tmp_path):
    WRITERS["cameras.json"](tmp_path)
    edit_json("cameras.json", cx=20.0, cy=15.0)(tmp_path)
    np.testing.assert_allclose(open_capture(tmp_path).K(0)[:2, 2], [20.0, 15.0])


def test_metashapes_disabled_cameras_and_other_chunks_are_named(tmp_path):
    WRITERS["Metashape"](tmp_path)
    text = (tmp_path / "cameras.xml").read_text().replace('label="1"', 'label="1" enabled="false"')
    text = text.replace("</document>", '<chunk><cameras><camera label="2"/></cameras></chunk></document>')
    (tmp_path / "cameras.xml").write_text(text)
    capture = open_capture(tmp_path)
    assert [frame.name for frame in capture.frames] == ["0", "2", "3"]
    assert [word in note for word, note in zip(("1 more chunks", "1 cameras"), capture.notes, strict=True)]


def test_a_component_without_a_transform_has_that_of_its_chunk(tmp_path):
    WRITERS["Metashape"](tmp_path)
    before = open_capture(tmp_path).camtoworlds
    text = (tmp_path / "cameras.xml").read_text()
    world = '<components><component id="0"/></components><transform><scale>2</scale></transform>'
    (tmp_path / "cameras.xml").write_text(text.replace("<cameras>", world + "<cameras>"))
    np.testing.assert_allclose(open_capture(tmp_path).camtoworlds[:, :3, 3], 2 * before[:, :3, 3])


def test_calibrations_of_tum_shrink_with_the_images_and_lost_poses_count_as_none(tmp_path):
    root = tmp_path / "freiburg3_desk"
    root.mkdir()
    write_tum(root)
    (root / "calibration.txt").unlink()
    for image in (root / "rgb").iterdir():
        write_image(image, size=(320, 240))
    rows = (root / "groundtruth.txt").read_text().split("\n")
    rows[1] = " ".join([rows[1].split()[0], *["nan"] * 7])
    (root / "groundtruth.txt").write_text("\n".join(rows))
    (root / "rgb.txt").write_text((root / "rgb.txt").read_text().replace(" rgb", "\trgb"))
    capture = open_capture(root)
    np.testing.assert_allclose(capture.K(0), [[267.7, 0, 160.3], [0, 269.6, 124.05], [0, 0, 1]])
    assert "1 of 4 frames" in capture.notes[0]


# -- units of depth in TUM's layout -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("file", "text", "depth"),
    [
        ("camera.yaml", "Camera.fx: 500\nDepthMapFactor: 1000.0\n", 7.5),
        ("cam_params.json", '{"camera": {"scale": 6553.5}}', 7500 / 6553.5),
        (None, "", 1.5),
    ],
)
def test_tum_depth_maps_have_the_unit_of_a_file_beside_them(file, text, depth, tmp_path):
    write_tum(tmp_path)
    if file is not None:
        (tmp_path / file).write_text(text)
    capture = open_capture(tmp_path)
    np.testing.assert_allclose(capture.depth(0), depth, rtol=1e-6)
    assert any("1/5000" in note for note in capture.notes) == (file is None)


# -- images -----------------------------------------------------------------------------------------------------------


def test_gray_of_12_bits_is_a_share_of_its_own_white(tmp_path):
    """A TIFF by hand: 12 bits of 1365 of 4095, two pixels in three bytes."""
    pixels = b"\x55\x55\x55" * (WIDTH * HEIGHT // 2)
    tags = ((256, WIDTH), (257, HEIGHT), (258, 12), (259, 1), (262, 1), (273, 8), (278, HEIGHT), (279, len(pixels)))
    table = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags)
    data = struct.pack("<2sHI", b"II", 42, 8 + len(pixels)) + pixels + struct.pack("<H", len(tags)) + table + bytes(4)
    change = another(2, "2.tif", lambda file: file.write_bytes(data))
    np.testing.assert_allclose(opened(tmp_path, change).image(2), 1 / 3, atol=1e-6)


@pytest.mark.parametrize(("suffix", "exif"), [("jpg", b"Exif\0\0II*\0\xff\xff\xff\xff"), ("png", b"no EXIF at all")])
def test_exif_data_that_cannot_be_read_say_nothing(suffix, exif, tmp_path):
    red = Image.new("RGB", (WIDTH, HEIGHT), (255, 0, 0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        capture = opened(tmp_path, another(2, f"2.{suffix}", lambda file: red.save(file, exif=exif)))
        assert capture.image(2)[5, 5, 0] > 0.9


@pytest.mark.parametrize("orientation", [3, 6])
def test_an_orientation_that_is_not_applied_is_noted(orientation, tmp_path):
    """The size of an image tells neither half a turn nor, if it is square, a quarter."""
    exif, side = Image.Exif(), HEIGHT if orientation == 6 else WIDTH
    exif[274] = orientation

    def change(root, meta):
        meta.update(w=side, cx=side / 2)
        for i in range(NUM_FRAMES):
            image = Image.new("RGB", (side, HEIGHT), (255, 0, 0))
            image.paste((0, 0, 255), (0, 0, side // 2, HEIGHT))
            image.save(root / "images" / f"{i}.jpg", exif=exif, quality=95)

    capture = opened(tmp_path, change)
    assert "4 images have an EXIF orientation" in capture.notes[0]
    assert capture.image(2)[HEIGHT // 2, 5, 2] > 0.9


# -- names, links, hidden files ---------------------------------------------------------------------------------------


def moved(i, name):
    """Moves the image of frame `i` within `images`, and leaves its name in the file."""

    def change(root, meta):
        (root / "images" / name).parent.mkdir(exist_ok=True)
        (root / "images" / f"{i}.jpg").rename(root / "images" / name)

    return change


def test_backslashes_are_slashes(tmp_path):
    capture = opened(tmp_path, moved(2, "left/2.jpg"), frame(2, file_path="images\\left\\2.jpg"))
    assert sorted(frame.path.name for frame in capture.frames) == [f"{i}.jpg" for i in range(4)]
    assert capture.notes == ()


@pytest.mark.parametrize(
    ("on_disk", "named"),
    [
        ("a b.jpg", "images/a%20b.jpg"),
        ("a%20b.jpg", "images/a%20b.jpg"),
        ("e\u0301.jpg", "images/\u00e9.jpg"),  # as macOS keeps it, and as most programs write it
        ("\u00e9.jpg", "images/e\u0301.jpg"),
        ("9.jpg", "/home/somebody/scene/images/9.jpg"),
        ("9.jpg", "C:\\scene\\images\\9.jpg"),
        ("9.JPG", "images/9.jpg"),
    ],
)
def test_names_of_other_machines_and_of_addresses_are_found(on_disk, named, tmp_path):
    capture = opened(tmp_path, moved(0, on_disk), frame(0, file_path=named))
    assert on_disk in {frame.path.name for frame in capture.frames} and len(capture) == NUM_FRAMES


FOLDERS = {"LLFF": "images", "KITTI": "image_2", "ScanNet": "color", "Polycam": "keyframes/images"}


@pytest.mark.parametrize("kind", FOLDERS)
@pytest.mark.parametrize("suffix", [".Jpg", ".TIF", ".bmp", ".WEBP"])
def test_a_folder_of_images_is_read_whatever_their_suffix(kind, suffix, tmp_path):
    WRITERS[kind](tmp_path)
    for image in sorted((tmp_path / FOLDERS[kind]).iterdir())[::2]:
        image.rename(image.with_suffix(suffix))
    assert len(open_capture(tmp_path)) == NUM_FRAMES


def test_archives_and_folders_around_a_capture_are_told_apart(tmp_path):
    make_capture(tmp_path / "download" / "fox")
    with pytest.raises(InputError, match=r"give the folder in it: .*fox"):
        open_capture(tmp_path / "download")
    (tmp_path / "fox.ZIP").write_bytes(b"PK")
    with pytest.raises(InputError, match="unpack it"):
        open_capture(tmp_path / "fox.ZIP")


@pytest.mark.parametrize("kind", ["COLMAP", "cameras.json", "LLFF", "transforms.json"])
def test_the_folder_of_images_may_be_a_link(kind, tmp_path):
    root = make_capture(tmp_path / "c") if kind == "transforms.json" else tmp_path / "c"
    if kind in WRITERS:
        root.mkdir()
        WRITERS[kind](root)
    (root / "images").rename(tmp_path / "elsewhere")
    (root / "images").symlink_to(tmp_path / "elsewhere")
    assert len(open_capture(root)) == NUM_FRAMES


@pytest.mark.parametrize("kind", ["COLMAP", *FOLDERS])
def test_hidden_files_are_no_images(kind, tmp_path):
    """macOS writes `._a.jpg` beside a.jpg on foreign disks."""
    WRITERS[kind](tmp_path)
    folder = tmp_path / FOLDERS.get(kind, "images")
    for name in sorted(file.name for file in folder.iterdir()):
        (folder / f"._{name}").write_bytes(b"Mac OS X")
    capture = open_capture(tmp_path)
    assert len(capture) == NUM_FRAMES and capture.notes == ()


def test_images_in_subfolders_and_with_another_suffix_are_found_and_counted(tmp_path):
    def as_png(root, meta):
        Image.open(root / "images" / "1.jpg").save(root / "images" / "1.png")
        (root / "images" / "1.jpg").unlink()

    capture = opened(tmp_path, moved(2, "left/2.jpg"), as_png)
    assert [frame.path.name for frame in capture.frames] == ["0.jpg", "1.png", "2.jpg", "3.jpg"]
    assert capture.notes[0].startswith("2 images were found in another folder or with another suffix")


def test_colmap_text_of_realityscan_is_read(tmp_path):
    """CRLF, blank lines of points, names with spaces, FULL_OPENCV, images at half the size."""
    params = "50 51 31 25 0.1 0 0 0 0 0.02 0 0"
    write_colmap_text(tmp_path, camera=f"1 FULL_OPENCV {2 * WIDTH} {2 * HEIGHT} {params}".replace("31 25", "62 50"))
    for file in ("cameras.txt", "images.txt"):
        lines = (tmp_path / "sparse" / "0" / file).read_text().split("\n")
        lines = ["" if len(line.split()) % 3 == 0 and line and not line.startswith("#") else line for line in lines]
        (tmp_path / "sparse" / "0" / file).write_bytes("\r\n".join(lines).encode())
    capture = open_capture(tmp_path)
    assert {frame.name for frame in capture.frames} == set(COLMAP_IMAGES)
    np.testing.assert_allclose(capture.K(0), [[25, 0, 31], [0, 25.5, 25], [0, 0, 1]])
    assert "0.5 times" in " ".join(capture.notes) and capture.frames[0].lens == Lens(k1=0.1, d1=0.02)


# -- cameras of other programs ----------------------------------------------------------------------------------------


def ring(num=8):
    """Camera-to-world matrices (OpenCV) on a ring, which look at its middle from a little above."""
    out = np.tile(np.eye(4), (num, 1, 1))
    for i, angle in enumerate(np.linspace(0, 2 * np.pi, num, endpoint=False)):
        center = np.array([3 * np.cos(angle), 3 * np.sin(angle), 1.0])
        forward = -center / np.linalg.norm(center)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        out[i, :3] = np.stack([right, np.cross(forward, right), forward, center], axis=1)
    return out


def write_ring(root, names):
    for i, name in enumerate(names):
        write_image(root / "images" / name, i)


def test_realitycaptures_cameras_come_back(tmp_path):
    names = [f"IMG {i}.jpg" for i in range(8)]
    write_ring(tmp_path, names)
    rows = ["#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"]
    for name, pose in zip(names, ring(), strict=True):
        forward, down = pose[:3, 2], pose[:3, 1]
        # A level camera (roll 0) that looks at the horizon has pitch 90, and heading 0 looks along +y.
        heading, pitch = np.degrees(np.arctan2(forward[0], forward[1])), 90 + np.degrees(np.arcsin(forward[2]))
        assert abs(down[:2] @ [-forward[1], forward[0]]) < 1e-12
        x, y, z = pose[:3, 3]
        rows.append(f"{name},{x:.9f},{y:.9f},{z:.9f},{heading:.9f},{pitch:.9f},0,30,0.9,-0.45,0.1,0,0,0,0.01,0.02")
    (tmp_path / "cameras.csv").write_text("\r\n".join(rows))
    capture = open_capture(tmp_path)
    assert capture.format == "RealityCapture" and len(capture) == 8
    np.testing.assert_allclose(capture.camtoworlds, ring(), atol=1e-7)
    unit = WIDTH / 36
    wanted = [[30 * unit, 0, WIDTH / 2 + 0.9 * unit], [0, 30 * unit, HEIGHT / 2 - 0.45 * unit], [0, 0, 1]]
    np.testing.assert_allclose(capture.K(0), wanted, rtol=1e-12)
    assert capture.frames[0].lens == Lens(k1=0.1, p1=0.01, p2=0.02)


@pytest.mark.parametrize("where", ["component", "chunk"])
def test_metashapes_cameras_come_back(where, tmp_path):
    """The chunk lies turned, moved and scaled in the world."""
    write_ring(tmp_path, [f"{i}.JPG" for i in range(8)])
    turn, shift, scale = Rotation.from_euler("xyz", [0.4, -1.1, 2.0]).as_matrix(), np.array([4e6, -2e5, 3e6]), 2.5
    chunk = ring()
    chunk[:, :3, :3] = turn.T @ chunk[:, :3, :3]
    chunk[:, :3, 3] = (chunk[:, :3, 3] - shift) @ turn / scale
    world = (
        f"<transform><rotation>{matrix_text(turn)}</rotation><translation>{matrix_text([shift])}</translation>"
        f"<scale>{scale}</scale></transform>"
    )
    around = {"after": world, "before": f'<components><component id="0">{world}</component></components>'}
    around = {name: around[name] for name in ["before" if where == "component" else "after"]}
    text = metashape_xml(chunk, lens="<k1>0.1</k1><p1>0.01</p1><p2>0.02</p2>", **around)
    text = text.replace("</cameras>", '<camera id="9" label="not aligned"/></cameras>')
    (tmp_path / "cameras.xml").write_text(text)
    (tmp_path / "sitemap.xml").write_text("<urlset></urlset>")  # of something else
    capture = open_capture(tmp_path)
    assert capture.format == "Metashape" and len(capture) == 8 and "1 of 9 frames" in capture.notes[0]
    np.testing.assert_allclose(capture.camtoworlds, ring(), atol=1e-5)
    np.testing.assert_allclose(capture.K(0), K)
    assert capture.frames[0].lens == Lens(k1=0.1, p1=0.02, p2=0.01)  # OpenCV's p1 is Metashape's p2


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"kind": "spherical"}, "perspective views"),
        ({"lens": "<b2>3</b2>"}, "b2"),
        ({"kind": "fisheye", "lens": "<p1>0.01</p1>"}, "p1 or p2"),
    ],
)
def test_metashapes_other_lenses_are_refused(options, words, tmp_path):
    write_ring(tmp_path, ["0.jpg"])
    (tmp_path / "cameras.xml").write_text(metashape_xml(ring()[:1], **options))
    with pytest.raises(InputError, match=words):
        open_capture(tmp_path)
