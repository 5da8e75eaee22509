"""Files as people bring them: fields that change a camera, odd names, links, hidden files, other programs' cameras."""

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
    edit_json,
    edit_text,
    matrix_text,
    poses,
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


def test_full_opencv_has_a_denominator(tmp_path):
    fields = top(camera_model="FULL_OPENCV", k1=0.2, k4=0.1, k5=-0.05, k6=0.02)
    assert opened(tmp_path, fields).frames[0].lens == Lens(k1=0.2, d1=0.1, d2=-0.05, d3=0.02)


@pytest.mark.parametrize("kind", ["depth_file_path", "depth_path"])
@pytest.mark.parametrize(
    ("fields", "unit"),
    [({}, 0.001), ({"integer_depth_scale": 10 / 65535}, 10 / 65535), ({"applied_scale": 0.25}, 0.00025)],
)
def test_depth_maps_have_the_unit_that_the_file_says(fields, unit, kind, tmp_path):
    depth = opened(tmp_path, top(**fields), depth_map(2, 19660, **{"depth_file_path": None, kind: "d.png"})).depth(2)
    np.testing.assert_allclose(depth, 19660 * unit, rtol=1e-6)


def test_bad_frames_are_left_out(tmp_path):
    capture = opened(tmp_path, frame(1, is_bad=True), frame(2, is_bad=False))
    assert [frame.name for frame in capture.frames] == ["images/0.jpg", "images/2.jpg", "images/3.jpg"]
    assert "is_bad" in capture.notes[0]


def test_a_folder_of_splits_opens_with_its_training_split(tmp_path):
    root = make_capture(tmp_path / "c")
    (root / "transforms.json").rename(root / "transforms_train.json")
    capture = open_capture(root)
    assert len(capture) == NUM_FRAMES and "transforms_train.json" in capture.notes[0]


# -- fields, matrices and images of other formats ---------------------------------------------------------------------


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


@pytest.mark.parametrize(
    ("on_disk", "named"),
    [
        ("a b.jpg", "images/a%20b.jpg"),
        ("a%20b.jpg", "images/a%20b.jpg"),
        ("e\u0301.jpg", "images/\u00e9.jpg"),  # as macOS keeps it, and as most programs write it
        ("\u00e9.jpg", "images/e\u0301.jpg"),
        ("9.jpg", "/home/somebody/scene/images/9.jpg"),
        ("9.jpg", "C:\\scene\\images\\9.jpg"),
        ("left/9.jpg", "images\\left\\9.jpg"),
        ("9.JPG", "images/9.jpg"),
    ],
)
def test_names_of_other_machines_and_of_addresses_are_found(on_disk, named, tmp_path):
    capture = opened(tmp_path, moved(0, on_disk), frame(0, file_path=named))
    assert len(capture) == NUM_FRAMES and any(frame.path.match(on_disk) for frame in capture.frames)


FOLDERS = {"LLFF": "images", "KITTI": "image_2", "ScanNet": "color", "Polycam": "keyframes/images"}


@pytest.mark.parametrize("kind", [*FOLDERS, "COLMAP"])
@pytest.mark.parametrize("suffix", [".Jpg", ".TIF", ".bmp", ".WEBP"])
def test_a_folder_of_images_is_read_whatever_their_suffix_without_hidden_files(kind, suffix, tmp_path):
    """macOS writes `._a.jpg` beside a.jpg on foreign disks."""
    WRITERS[kind](tmp_path)
    folder = tmp_path / FOLDERS.get(kind, "images")
    for i, image in enumerate(sorted(folder.iterdir())):
        (folder / f"._{image.name}").write_bytes(b"Mac OS X")
        if i % 2 == 0 and kind in FOLDERS:  # COLMAP's model names its images
            image.rename(image.with_suffix(suffix))
    capture = open_capture(tmp_path)
    assert len(capture) == NUM_FRAMES and capture.notes == ()


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


def test_images_in_subfolders_and_with_another_suffix_are_found_and_counted(tmp_path):
    capture = opened(tmp_path, moved(2, "left/2.jpg"), moved(1, "1.png"))
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


BENT = "<k1>0.1</k1><p1>0.01</p1><p2>0.02</p2>"  # OpenCV's p1 is Metashape's p2


@pytest.mark.parametrize(
    ("kind", "file", "old", "new", "lens"),
    [
        ("RealityCapture", "cameras.csv", ",0,0,0,0,0,0", ",0.1,0,0,0,0.01,0.02", Lens(k1=0.1, p1=0.01, p2=0.02)),
        ("Metashape", "cameras.xml", "<b1>", f"{BENT}<b1>", Lens(k1=0.1, p1=0.02, p2=0.01)),
    ],
)
def test_lenses_of_other_programs_have_the_coefficients_of_opencv(kind, file, old, new, lens, tmp_path):
    WRITERS[kind](tmp_path)
    edit_text(file, lambda text: text.replace(old, new))(tmp_path)
    assert {frame.lens for frame in open_capture(tmp_path).frames} == {lens}


@pytest.mark.parametrize("where", ["component", "chunk", "chunk of a component without one"])
def test_metashapes_cameras_lie_in_their_chunk(where, tmp_path):
    """The chunk lies turned, moved and scaled in the world."""
    WRITERS["Metashape"](tmp_path)
    turn, shift, scale = Rotation.from_euler("xyz", [0.4, -1.1, 2.0]).as_matrix(), np.array([4e6, -2e5, 3e6]), 2.5
    world = (
        f"<transform><rotation>{matrix_text(turn)}</rotation><translation>{matrix_text([shift])}</translation>"
        f"<scale>{scale}</scale></transform>"
    )
    before = {
        "component": f'<components><component id="0">{world}</component></components>',
        "chunk": world,
        "chunk of a component without one": f'<components><component id="0"/></components>{world}',
    }[where]
    text = (tmp_path / "cameras.xml").read_text().replace("<cameras>", f"{before}<cameras>")
    text = text.replace("</cameras>", '<camera id="9" label="not aligned"/></cameras>')
    (tmp_path / "cameras.xml").write_text(text)
    (tmp_path / "sitemap.xml").write_text("<urlset></urlset>")  # of something else
    capture = open_capture(tmp_path)
    assert len(capture) == NUM_FRAMES and "1 of 5 frames" in capture.notes[0]
    np.testing.assert_allclose(capture.camtoworlds[:, :3, :3], turn @ poses()[:, :3, :3], atol=1e-9)
    np.testing.assert_allclose(capture.camtoworlds[:, :3, 3], scale * poses()[:, :3, 3] @ turn.T + shift, atol=1e-5)
