"""Reading a capture: conventions, change of size, chunks. What bad captures get is in tests/badinputs."""

import json

import jax
import numpy as np
import pytest
from PIL import Image

from ssplat_jax.config import StreamConfig
from ssplat_jax.data.capture import Capture, open_capture
from ssplat_jax.data.images import ArrayPixels, Crop
from ssplat_jax.data.posed_image import Frame, check_camtoworld
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.errors import InputError
from ssplat_jax.geometry.cameras import project_points, transform_points
from tests.badinputs.cases import HEIGHT, WIDTH, good_capture, rotated, write_capture

FLOAT32_PIXELS = 1e-3
EIGHT_BITS = 0.5 / 255


def make(root, change=lambda root, meta: None):
    meta = good_capture(root)
    change(root, meta)
    write_capture(root, meta)
    return root


def smooth_capture(num_frames=6, height=48, width=64):
    """A capture in memory whose images are smooth functions of the pixel coordinate: image = (x, y, i) scaled."""
    ys, xs = np.meshgrid(np.arange(height) + 0.5, np.arange(width) + 0.5, indexing="ij")
    images = np.stack([np.stack([xs / width, ys / height, 0 * xs + i / 10], -1) for i in range(num_frames)])
    depths = np.stack([1 + xs / width + i for i in range(num_frames)])
    frames = []
    for i in range(num_frames):
        pose = rotated(10.0 * i)
        pose[:3, 3] = [0.3 * i, 0.05 * i, 0.1]
        K = np.array([[60.0, 0, 30.0], [0, 61.0, 26.0], [0, 0, 1]])
        frames.append(Frame(name=str(i), camtoworld=pose, K=K, width=width, height=height))
    pixels = ArrayPixels(images=images.astype(np.float32), depths=depths.astype(np.float32))
    return Capture(name="smooth", format="memory", frames=tuple(frames), pixels=pixels, width=width, height=height)


def resized(capture, width, height):
    return Capture(
        name=capture.name,
        format=capture.format,
        frames=capture.frames,
        pixels=capture.pixels,
        width=width,
        height=height,
    )


def frame_of(capture, scale=1.0):
    return StreamFrame.at_camera(capture.frames[0].camtoworld, scale=scale, near=0.5, far=8.0)


# -- the transforms.json reader ---------------------------------------------------------------------------------------


def test_poses_become_opencv_and_keep_their_frame(tmp_path):
    """OpenGL looks along -z with +y up: the center stays, the second and third axis turn round."""
    opengl = rotated(30.0)
    opengl[:3, 3] = [1.0, 2.0, 3.0]

    def change(root, meta):
        meta["frames"][1]["transform_matrix"] = opengl.tolist()
        meta["applied_transform"] = [[0, 1, 0, 5], [1, 0, 0, 5], [0, 0, -1, 5]]

    pose = open_capture(make(tmp_path / "c", change)).frames[1].camtoworld
    np.testing.assert_array_equal(pose[:, 3], opengl[:, 3])
    np.testing.assert_allclose(pose[:3, 0], opengl[:3, 0], atol=1e-15)
    np.testing.assert_allclose(pose[:3, 1:3], -opengl[:3, 1:3], atol=1e-15)


def test_frames_stream_in_natural_order(tmp_path):
    def change(root, meta):
        for i, name in enumerate(("10", "9", "2b", "2a")):
            (root / "images" / f"{i}.jpg").rename(root / "images" / f"{name}.jpg")
            meta["frames"][i]["file_path"] = f"images/{name}.jpg"

    names = [frame.name for frame in open_capture(make(tmp_path / "c", change)).frames]
    assert names == ["images/2a.jpg", "images/2b.jpg", "images/9.jpg", "images/10.jpg"]


def test_a_frames_own_intrinsics_come_first(tmp_path):
    capture = open_capture(make(tmp_path / "c", lambda root, meta: meta["frames"][2].update(fl_x=70.0, cx=10)))
    np.testing.assert_array_equal(capture.K(2), [[70, 0, 10], [0, 51, 25], [0, 0, 1]])
    np.testing.assert_array_equal(capture.K(1), [[50, 0, 31], [0, 51, 25], [0, 0, 1]])


def test_blenders_angle_and_missing_extension(tmp_path):
    def change(root, meta):
        for name in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
            del meta[name]
        meta["camera_angle_x"] = 2 * np.arctan(0.5)
        for frame in meta["frames"]:
            frame["file_path"] = frame["file_path"].removesuffix(".jpg")

    capture = open_capture(make(tmp_path / "c", change))
    wanted = [[WIDTH, 0, WIDTH / 2], [0, WIDTH, HEIGHT / 2], [0, 0, 1]]
    np.testing.assert_allclose(capture.K(0), wanted, rtol=1e-14)


def test_the_digest_of_images_is_of_the_frames_named_and_their_bytes(tmp_path):
    capture = open_capture(make(tmp_path))
    before = capture.images_digest([0, 1])
    assert before != capture.images_digest([1, 0]) != capture.images_digest([1])
    Image.new("RGB", (WIDTH, HEIGHT), (1, 2, 3)).save(capture.frames[2].path)
    assert capture.images_digest([0, 1]) == before
    Image.new("RGB", (WIDTH, HEIGHT), (1, 2, 3)).save(capture.frames[1].path)
    assert capture.images_digest([0, 1]) != before


def test_a_file_of_any_name_and_odd_file_names_are_read(tmp_path):
    def change(root, meta):
        (root / "images" / "1.jpg").rename(root / "images" / "Küche 1.JPG")
        meta["frames"][1]["file_path"] = "images/Küche 1"

    root = make(tmp_path / "c", change)
    (root / "transforms.json").rename(root / "transforms_train.json")
    capture = open_capture(root / "transforms_train.json")
    assert len(capture) == 4 and capture.name == "c" and capture.format == "transforms.json"
    capture.verify()


def test_byte_order_mark_and_crlf_are_read(tmp_path):
    root = make(tmp_path / "c")
    text = json.dumps(json.loads((root / "transforms.json").read_text()), indent=1)
    (root / "transforms.json").write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())
    assert len(open_capture(root)) == 4


def test_a_pose_almost_a_rotation_is_projected_and_reported(tmp_path):
    def change(root, meta):
        meta["frames"][1]["transform_matrix"][0][1] = 5e-4

    capture = open_capture(make(tmp_path / "c", change))
    rotation = capture.frames[1].camtoworld[:3, :3]
    np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), rtol=0, atol=1e-14)
    assert np.abs(rotation - np.diag([1.0, -1, -1])).max() < 5e-4
    assert len(capture.notes) == 1 and "1 poses" in capture.notes[0]


def test_three_rows_are_a_pose():
    pose, deviation = check_camtoworld(rotated(20.0)[:3].tolist(), "here")
    np.testing.assert_allclose(pose, rotated(20.0), atol=1e-15)
    assert deviation < 1e-15


def test_distortion_too_small_to_see_is_ignored_and_reported(tmp_path):
    capture = open_capture(make(tmp_path / "c", lambda root, meta: meta.update(k1=0.01)))
    assert 0.1 < capture.frames[0].distortion_px < 0.5
    assert "distortion" in capture.notes[0]


def test_shrunk_images_shrink_their_intrinsics(tmp_path):
    """nerfstudio's images_2: the file still describes the full size."""
    full = open_capture(make(tmp_path / "a"))
    names = ("w", "h", "fl_x", "fl_y", "cx", "cy")

    def describe_twice_the_size(root, meta):
        meta.update({name: 2 * value for name, value in zip(names, (WIDTH, HEIGHT, *intrinsics(full)), strict=True)})

    shrunk = open_capture(make(tmp_path / "b", describe_twice_the_size))
    np.testing.assert_allclose(shrunk.frames[1].K, full.frames[1].K, rtol=1e-12)
    assert (shrunk.width, shrunk.height) == (WIDTH, HEIGHT) and "0.5 times" in shrunk.notes[0]


def test_images_of_a_shrunk_folder_stand_in_for_missing_ones(tmp_path):
    root = make(tmp_path / "c")
    (root / "images").rename(root / "images_4")
    capture = open_capture(root)
    assert {frame.path.parent.name for frame in capture.frames if frame.path} == {"images_4"}

    def dotted(root, meta):
        (root / "images").rename(root / "images_4")
        meta["frames"] = [frame | {"file_path": f"./{frame['file_path']}"} for frame in meta["frames"]]

    capture = open_capture(make(tmp_path / "dotted", dotted))
    assert {frame.path.parent.name for frame in capture.frames if frame.path} == {"images_4"}


@pytest.mark.parametrize("path", ["~nosuchuser/capture", "a" * 300, "a\0b"])
def test_what_can_be_no_path_is_refused(path):
    with pytest.raises(InputError, match=r"wanted a p(ath|osed capture)"):
        open_capture(path)


def test_a_principal_point_far_off_the_centre_is_told(tmp_path):
    def describe(root, meta):
        meta.pop("w"), meta.pop("h")
        meta.update(cx=0.9 * WIDTH, cy=0.5 * HEIGHT)

    assert any(
        "principal point lies 40% of a side off" in note for note in open_capture(make(tmp_path / "c", describe)).notes
    )
    assert not any("principal point" in note for note in open_capture(make(tmp_path / "centered")).notes)


def test_a_depth_map_of_null_is_none(tmp_path):
    def describe(root, meta):
        meta["frames"][0]["depth_file_path"] = None

    assert open_capture(make(tmp_path / "c", describe)).frames[0].depth_path is None


def test_an_angle_of_view_too_small_to_divide_by_is_refused(tmp_path):
    def describe(root, meta):
        meta.pop("fl_x", None), meta.pop("fl_y", None)
        meta["camera_angle_x"] = 5e-324

    with pytest.raises(InputError, match="an angle in"):
        open_capture(make(tmp_path / "c", describe))


@pytest.mark.parametrize("turned", [False, True], ids=["landscape", "portrait"])
def test_the_longer_side_says_how_far_images_were_shrunk(tmp_path, turned):
    """1087 / 8 is rounded down to 135: scaled by the ratio of the short sides, the long one would be off by more."""
    wanted, stored = ((1087, 1920), (135, 240)) if turned else ((1920, 1087), (240, 135))

    def describe(root, meta):
        for path in (root / "images").iterdir():
            Image.new("RGB", stored).save(path)
        meta.update(w=wanted[0], h=wanted[1], fl_x=1500.0, fl_y=1500.0, cx=wanted[0] / 2, cy=wanted[1] / 2)

    capture = open_capture(make(tmp_path / "c", describe))
    np.testing.assert_allclose(intrinsics(capture)[:2], 1500 / 8)


def intrinsics(capture):
    K = capture.frames[0].K
    return K[0, 0], K[1, 1], K[0, 2], K[1, 2]


def test_names_without_an_order_leave_the_files(tmp_path):
    """Random names, or all left images before all right ones: the camera's way tells."""

    def rename(root, meta):
        for name, entry, x in zip("cadb", meta["frames"], range(4), strict=False):
            path = root / entry["file_path"]
            entry["file_path"] = f"images/{name}{path.suffix}"
            path.rename(root / entry["file_path"])
            entry["transform_matrix"][0][3] = float(x)

    def names(capture):
        return [frame.name[7] for frame in capture.frames]

    told = open_capture(make(tmp_path / "d", rename))
    assert names(told) == list("cadb")
    assert any("file's order" in note for note in told.notes)


def test_rotations_of_three_decimals_are_rotations():
    for degrees in range(0, 180, 7):
        check_camtoworld(np.round(rotated(float(degrees)) @ tilted(degrees / 3), 3).tolist(), "here")


def tilted(degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[1, 0, 0, 0], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1.0]])


def test_depth_is_meters_from_millimeters_and_zero_is_unknown(tmp_path):
    def change(root, meta):
        depth = np.full((HEIGHT, WIDTH), 1500, np.uint16)
        depth[0, 0], depth[0, 1] = 0, 65535
        Image.fromarray(depth).save(root / "d.png")
        meta["frames"][2]["depth_file_path"] = "d.png"

    capture = open_capture(make(tmp_path / "c", change))
    depth = capture.depth(2)
    assert capture.depth(1) is None and depth is not None
    np.testing.assert_allclose([depth[0, 0], depth[0, 1], depth[5, 5]], [0, 65.535, 1.5], rtol=1e-6)


@pytest.mark.parametrize("mode", ["RGB", "L", "P", "RGBA", "CMYK", "I;16", "1"])
def test_every_kind_of_image_becomes_rgb(tmp_path, mode):
    """A uniform gray of 60 % stays that, whatever the file holds it in; transparency is over black."""
    value = 153
    if mode == "I;16":
        stored, wanted = Image.fromarray(np.full((HEIGHT, WIDTH), 39321, np.uint16)), 0.6
    elif mode == "RGBA":
        stored, wanted = Image.new("RGBA", (WIDTH, HEIGHT), (value, value, value, 51)), 0.6 * 0.2
    elif mode == "1":
        stored, wanted = Image.new("1", (WIDTH, HEIGHT), 1), 1.0
    else:
        stored, wanted = Image.new("RGB", (WIDTH, HEIGHT), (value,) * 3).convert(mode), 0.6

    def change(root, meta):
        stored.save(root / "images" / "2.tif")
        meta["frames"][2]["file_path"] = "images/2.tif"

    image = open_capture(make(tmp_path / "c", change)).image(2)
    assert image.shape == (HEIGHT, WIDTH, 3) and image.dtype == np.float32
    np.testing.assert_allclose(image, wanted, atol=3 * EIGHT_BITS)


def test_exif_orientation_is_not_applied(tmp_path):
    """Intrinsics belong to the stored pixels."""

    def change(root, meta):
        exif = Image.Exif()
        exif[0x0112] = 6
        image = Image.new("RGB", (WIDTH, HEIGHT), (255, 0, 0))
        image.paste((0, 0, 255), (0, 0, WIDTH // 2, HEIGHT))
        image.save(root / "images" / "2.jpg", exif=exif, quality=95)

    image = open_capture(make(tmp_path / "c", change)).image(2)
    assert image[HEIGHT // 2, 5, 2] > 0.9 and image[HEIGHT // 2, -5, 0] > 0.9


# -- change of size ---------------------------------------------------------------------------------------------------

SIZES = [(64, 48), (32, 24), (32, 32), (24, 48), (100, 20), (63, 47), (128, 96)]


@pytest.mark.parametrize("size", SIZES)
def test_a_point_moves_to_where_its_color_moves(size):
    """The image holds its own coordinates, so what the intrinsics say must agree with what the pixels show."""
    capture = smooth_capture()
    small = resized(capture, *size)
    old, new = capture.K(0), small.K(0)
    image = small.image(0)
    assert image.shape == (size[1], size[0], 3)
    columns, rows = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    rays = np.stack([(columns - new[0, 2]) / new[0, 0], (rows - new[1, 2]) / new[1, 1]], -1)
    stored = rays * [old[0, 0], old[1, 1]] + old[:2, 2]
    inner = (slice(size[1] // 5, -(size[1] // 5)), slice(size[0] // 5, -(size[0] // 5)))  # away from the filter's edge
    shown = image[..., :2] * [64, 48]
    np.testing.assert_allclose(shown[inner], stored[inner], rtol=0, atol=0.05)  # pixels; half a pixel would be 0.5
    depth = small.depth(0)
    assert depth is not None and depth.shape == image.shape[:2]
    np.testing.assert_allclose(depth, 1 + stored[..., 0] / 64, rtol=0, atol=0.51 / 64 * (1 + 1e-5))


@pytest.mark.parametrize("size", SIZES)
def test_the_crop_is_centred_and_covers(size):
    crop = Crop.cover((64, 48), size)
    corners = [crop.left, crop.top, crop.left + size[0] / crop.scale, crop.top + size[1] / crop.scale]
    np.testing.assert_allclose([corners[0] + corners[2], corners[1] + corners[3]], [64, 48], rtol=1e-14)
    assert corners[0] >= -1e-12 and corners[1] >= -1e-12 and min(crop.left, crop.top) < 1e-12


def test_own_size_leaves_pixels_alone(tmp_path):
    root = make(tmp_path / "c")
    with Image.open(root / "images" / "1.jpg") as stored:
        wanted = np.asarray(stored, np.float32) / 255
    np.testing.assert_array_equal(open_capture(root).image(1), wanted)
    np.testing.assert_array_equal(open_capture(root, size=(WIDTH, HEIGHT)).image(1), wanted)


def test_depth_maps_of_another_resolution_follow(tmp_path):
    def change(root, meta):
        depth = np.repeat(np.arange(1, WIDTH // 2 + 1, dtype=np.uint16)[None] * 100, HEIGHT // 2, axis=0)
        Image.fromarray(depth).save(root / "d.png")
        meta["frames"][0]["depth_file_path"] = "d.png"

    depth = open_capture(make(tmp_path / "c", change)).depth(0)
    assert depth is not None and depth.shape == (HEIGHT, WIDTH)
    np.testing.assert_allclose(depth[3, :6], [0.1, 0.1, 0.2, 0.2, 0.3, 0.3], rtol=1e-6)


# -- chunks -----------------------------------------------------------------------------------------------------------


def test_a_capture_point_is_seen_at_the_same_pixel_after_size_and_stream_frame():
    capture = resized(smooth_capture(), 40, 40)
    frame = frame_of(capture, scale=2.5)
    rng = np.random.default_rng(0)
    for i in range(len(capture)):
        stored, pose = capture.frames[i], capture.frames[i].camtoworld
        in_camera = np.concatenate([rng.uniform(-0.3, 0.3, (20, 2)), rng.uniform(1, 3, (20, 1))], -1)
        pixel = (in_camera @ stored.K.T)[:, :2] / in_camera[:, 2:]
        crop = capture.crop(i)
        wanted = (pixel - [crop.left, crop.top]) * crop.scale
        points = frame.points_to_stream(in_camera @ pose[:3, :3].T + pose[:3, 3]).astype(np.float32)
        camera = capture.camera(i, frame)
        got, depths = project_points(transform_points(camera.viewmats, jax.numpy.asarray(points)), camera.Ks)
        np.testing.assert_allclose(got, wanted, rtol=0, atol=FLOAT32_PIXELS)
        np.testing.assert_allclose(depths, 2.5 * in_camera[:, 2], rtol=1e-5)


def test_a_scaled_capture_is_seen_alike_by_smaller_images():
    capture = resized(smooth_capture(), 40, 40)
    half = capture.scaled(0.5)
    assert (half.width, half.height) == (20, 20)
    point = np.array([0.1, -0.2, 2.0])
    for i in range(len(capture)):
        pixels = [(c.K(i) @ point)[:2] / point[2] for c in (half, capture)]
        np.testing.assert_allclose(2 * pixels[0], pixels[1], rtol=1e-12)
        np.testing.assert_allclose(half.image(i).mean(axis=(0, 1)), capture.image(i).mean(axis=(0, 1)), atol=0.01)
    assert (capture.scaled(1e-9).width, capture.scaled(1e-9).height) == (1, 1)


def test_chunks_hold_the_frames_in_order_and_pad_the_last():
    capture = smooth_capture()
    frame = frame_of(capture)
    used = [5, 0, 1, 3, 2, 4]
    chunks = list(capture.chunks(StreamConfig().replace(chunk_size=4), used, frame=frame))
    assert [chunk.valid.tolist() for chunk in chunks] == [[True] * 4, [True, True, False, False]]
    rows = [(c.images[v], c.viewmats[v], c.Ks[v]) for c in chunks for v in range(4) if c.valid[v]]
    for i, (image, viewmat, K) in zip(used, rows, strict=True):
        camera = capture.camera(i, frame)
        np.testing.assert_array_equal(image, capture.image(i))
        np.testing.assert_array_equal(viewmat, camera.viewmats)
        np.testing.assert_array_equal(K, camera.Ks)
    assert not chunks[1].images[2:].any()
    np.testing.assert_array_equal(chunks[1].viewmats[2:], np.broadcast_to(np.eye(4), (2, 4, 4)))
    np.testing.assert_array_equal(chunks[1].Ks[2:], np.broadcast_to(capture.K(2).astype(np.float32), (2, 3, 3)))
    assert all(float(chunk.near) == 0.5 and float(chunk.far) == 8.0 for chunk in chunks)


def test_all_chunks_have_one_structure():
    """So that a jitted step compiles once."""
    capture = smooth_capture()
    shapes = {str(jax.eval_shape(lambda c: c, c)) for c in capture.chunks(StreamConfig(), frame=frame_of(capture))}
    assert len(shapes) == 1


def test_own_frame_is_that_of_the_first_frame_used():
    capture = smooth_capture()
    frame = capture.stream_frame(StreamConfig().replace(scene_scale=3.0), [2, 3, 4])
    np.testing.assert_array_equal(frame.origin, capture.frames[2].center)
    assert frame.scale == 3.0 and 0 < frame.near < frame.far


def test_reading_ahead_raises_where_the_damage_is(tmp_path):
    root = make(tmp_path / "c")
    capture = open_capture(root)
    (root / "images" / "2.jpg").write_bytes(b"gone bad")
    chunks = capture.chunks(StreamConfig().replace(chunk_size=2), frame=frame_of(capture))
    next(chunks)
    with pytest.raises(ValueError, match=r"2\.jpg"):
        next(chunks)


@pytest.mark.parametrize("indices", [[], [4], [-1]])
def test_frames_that_are_not_there_are_refused(tmp_path, indices):
    capture = open_capture(make(tmp_path / "c"))
    with pytest.raises(ValueError, match="frame numbers"):
        next(capture.chunks(StreamConfig(), indices))
