"""Photos become upright, of bounded size, with their focal length; frames of a video are sharp, at equal motion."""

import os
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image, ImageOps
from scipy.ndimage import gaussian_filter

from ssplat_jax.core.console import Reporter
from ssplat_jax.core.errors import InputError
from ssplat_jax.poses import estimate, gather_images
from ssplat_jax.poses.gather_images import STEP, choose_frames, copy_photos, list_photos, scan_video

av = pytest.importorskip("av", reason="videos need PyAV: pip install -e '.[poses]'")

FOCAL_LENGTH_35MM, EXIF_BLOCK, ORIENTATION, MAKE, EDITOR = 0xA405, 0x8769, 274, 271, 37724
WIDTH, HEIGHT, NUM_FRAMES = 192, 108, 30


def save(path, size=(40, 30)):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", size).save(path)


def copy(tmp_path, max_side=1600):
    (tmp_path / "out").mkdir(exist_ok=True)
    return copy_photos(list_photos(tmp_path / "in"), tmp_path / "out", max_side, lambda done: None)


def test_upright_photos_are_copied_as_they_are(tmp_path):
    for name in ("10.jpg", "9.jpg", "b 1.png", "#1 a.jpg", os.fsdecode(b"\xe9.jpg"), "b#.jpg"):
        save(tmp_path / "in" / name)
    (tmp_path / "in" / "note.txt").write_text("no photo")
    names = copy(tmp_path)  # in natural order, with underscores for what COLMAP cannot list
    assert [name for name in names if name[0].isdigit()] == ["9.jpg", "10.jpg"]
    assert sorted(names) == ["10.jpg", "9.jpg", "_.jpg", "_1_a.jpg", "b#.jpg", "b_1.png"]
    assert (tmp_path / "out" / "9.jpg").read_bytes() == (tmp_path / "in" / "9.jpg").read_bytes()


def test_what_colmap_cannot_read_is_converted_and_hidden_files_are_left_out(tmp_path):
    """macOS writes `._1.jpg` beside images; photographs of more pixels than a capture may have are reduced."""
    save(tmp_path / "in" / "1.webp")
    (tmp_path / "in" / "._1.jpg").write_bytes(b"Mac OS X")
    Image.new("L", (9000, 9000)).save(tmp_path / "in" / "2.jpg", quality=1)
    Image.new("RGB", (40, 30)).save(tmp_path / "in" / "3.bmp")
    assert copy(tmp_path, max_side=900) == ["1.jpg", "2.jpg", "3.jpg"]
    sizes = []
    for file in sorted((tmp_path / "out").iterdir()):
        with Image.open(file) as picture:
            assert picture.format == "JPEG"
            sizes.append(picture.size)
    assert sizes == [(40, 30), (900, 900), (40, 30)]


def test_photos_may_lie_in_images_and_beside_unreadable_copies(tmp_path):
    for name in ("1.jpg", "2.JPG", "3.png"):
        save(tmp_path / "images" / name)
    for name in ("1.heic", "4.HEIC", "5.avif"):
        (tmp_path / "images" / name).write_bytes(b"x")
    with pytest.raises(InputError, match="2 HEIC, AVIF or JPEG XL files beside 3 others; convert"):
        list_photos(tmp_path)
    for name in ("4.jpg", "5.jpg"):
        save(tmp_path / "images" / name)
    assert [photo.name for photo in list_photos(tmp_path)] == ["1.jpg", "2.JPG", "3.png", "4.jpg", "5.jpg"]


def test_unusable_photos_are_refused_by_name(tmp_path):
    with pytest.raises(InputError, match="fewer than two images"):
        list_photos(tmp_path)
    save(tmp_path / "in" / "a b.jpg")
    save(tmp_path / "in" / "a_b.jpg")
    with pytest.raises(InputError, match=r"'a_b\.jpg' twice"):
        copy(tmp_path)
    (tmp_path / "in" / "a_b.jpg").unlink()
    save(tmp_path / "in" / "c.jpg", size=(400, 300))
    whole = (tmp_path / "in" / "c.jpg").read_bytes()
    (tmp_path / "in" / "c.jpg").write_bytes(whole[: len(whole) * 2 // 3])
    with pytest.raises(InputError, match=r"c\.jpg: wanted a readable file.*remove the file"):
        copy(tmp_path)


def test_reduced_photos_keep_their_focal_length_and_brightness(tmp_path):
    """A TIFF's tags are all EXIF data, such as those of an editor, which no JPEG file has room for."""
    exif = Image.Exif()
    exif[MAKE], exif[EDITOR] = "Maker", b"x" * 70_000
    exif.get_ifd(EXIF_BLOCK)[FOCAL_LENGTH_35MM] = 26
    (tmp_path / "in").mkdir()
    Image.new("RGB", (400, 300)).save(tmp_path / "in" / "1.png", exif=exif)
    ramp = np.tile(np.linspace(0, 65535, 400).astype(np.uint16), (300, 1))
    Image.fromarray(ramp).save(tmp_path / "in" / "2.png")  # gray of 16 bits keeps its mean
    assert copy(tmp_path, max_side=100) == ["1.jpg", "2.jpg"]
    with Image.open(tmp_path / "out" / "2.jpg") as picture:
        assert np.asarray(picture).mean() / 255 == pytest.approx(0.5, abs=0.02)
    with Image.open(tmp_path / "out" / "1.jpg") as picture:
        kept = picture.getexif()
        assert kept[MAKE] == "Maker" and EDITOR not in kept
        assert kept.get_ifd(EXIF_BLOCK)[FOCAL_LENGTH_35MM] == 26


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize(("max_side", "is_written"), [(100, True), (79, True), (79, False)])
def test_photos_are_upright_even_if_their_exif_data_cannot_be_written(
    orientation, max_side, is_written, tmp_path, monkeypatch
):
    """Pillow's own transposition, which needs to write the data, is the reference."""
    (tmp_path / "in").mkdir()
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    exif.get_ifd(EXIF_BLOCK)[FOCAL_LENGTH_35MM] = 26
    quarters = np.kron([[0, 80], [160, 240]], np.ones((30, 40))).astype(np.uint8)
    for name in ("1.png", "2.png"):
        Image.fromarray(quarters).save(tmp_path / "in" / name, exif=exif)
    with Image.open(tmp_path / "in" / "1.png") as picture:
        wanted = np.asarray(ImageOps.exif_transpose(picture))

    def broken(self, *given):
        raise TypeError("a tag of another type")

    if not is_written:
        monkeypatch.setattr(Image.Exif, "tobytes", broken)
    name, _ = copy(tmp_path, max_side)
    with Image.open(tmp_path / "out" / name) as picture:
        assert max(picture.size) == min(80, max_side)
        found = np.asarray(picture.convert("L").resize(wanted.shape[::-1]), np.float64)
        exif = picture.getexif()
    assert np.median(np.abs(found - wanted)) < 3
    assert exif.get(ORIENTATION, 1) == 1
    assert exif.get_ifd(EXIF_BLOCK).get(FOCAL_LENGTH_35MM) == (26 if is_written else None)


# Videos.

WALL = gaussian_filter(np.random.default_rng(0).uniform(0, 255, (200, 1200)), 1.5) * 3
WALL = (255 * (WALL - WALL.min()) / np.ptp(WALL)).astype(np.float32)


def view(x, y=0):
    """Part of a textured wall, `x` pixels along it; between pixels, the two neighbors are mixed."""
    low, share = int(x), np.float32(x - int(x))
    window = WALL[y : y + HEIGHT, low : low + WIDTH + 1]
    return (1 - share) * window[:, :-1] + share * window[:, 1:]


@pytest.mark.parametrize(("x", "y"), [(0, 0), (3, 0), (0, 5), (6, 8), (17, 0)])
def test_displacement_is_the_length_of_the_shift(x, y):
    assert gather_images.displacement(view(100, 20), view(100 + x, 20 + y)) == pytest.approx(np.hypot(x, y))


def played(gray):
    """A frame of a video as PyAV gives it."""
    frame = SimpleNamespace(width=WIDTH, height=HEIGHT, to_ndarray=lambda: gray)
    frame.reformat = lambda **given: frame
    return frame


@pytest.mark.parametrize("speed", [0.0, 0.3, 2.0, 9.0])
def test_motion_adds_up_at_any_speed_and_noise_is_none(speed, monkeypatch):
    rng = np.random.default_rng(1)
    noisy = [view(speed * i + 50) + rng.normal(0, 0 if speed else 3, (HEIGHT, WIDTH)) for i in range(60)]
    monkeypatch.setattr(gather_images, "_frames", lambda path: map(played, noisy))
    motion, _ = scan_video(Path("any"), lambda done: None)
    assert motion[0] == 0 and (np.diff(motion) >= 0).all()
    # Whole pixels: off by one at the last key frame at most, and by rounding at each key frame.
    assert motion[-1] * WIDTH == pytest.approx(speed * 59, rel=0.12, abs=1.5)


def test_chosen_frames_are_at_equal_steps_of_motion():
    """At half the speed, twice as many frames pass between two chosen ones; nothing is chosen twice while it stands."""
    motion = np.concatenate([np.linspace(0, 2, 100), np.full(80, 2.0), np.linspace(2, 4, 200)])
    chosen = choose_frames(motion, np.ones(len(motion)), 1000)
    gaps = np.diff(motion[chosen])
    assert gaps.min() >= 0.5 * STEP and gaps.max() <= 1.5 * STEP
    assert len(chosen) == pytest.approx(4 / STEP + 1, abs=1)
    assert ((chosen >= 100) & (chosen < 180)).sum() <= 1
    cut = choose_frames(np.concatenate([np.linspace(0, 1, 100), np.linspace(3, 4, 100)]), np.ones(200), 1000)
    assert {99, 100} <= set(cut.tolist()) and (np.diff(cut) > 0).all()  # a cut is bridged by the nearest frames


def test_the_sharpest_frame_near_a_step_is_chosen():
    motion = np.linspace(0, 4, 401)  # 5 frames a step
    sharpnesses = np.random.default_rng(2).uniform(1, 2, 401)
    sharpnesses[::2] = 0.1  # every second frame is blurred
    chosen = choose_frames(motion, sharpnesses, 1000)
    assert (chosen[1:-1] % 2 == 1).all() and len(chosen) >= 80
    for i in chosen[1:-1]:
        around = np.abs(motion - round(float(motion[i]) / STEP) * STEP) <= STEP / 4 + 1e-9
        assert sharpnesses[i] == sharpnesses[around].max()


def write_video(path, images):
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", Fraction(10), options={"crf": "10"})
        stream.height, stream.width = images[0].shape
        stream.pix_fmt = "yuv420p"
        for image in images:
            picture = np.ascontiguousarray(image.astype(np.uint8)[..., None].repeat(3, -1))
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())


def test_a_video_is_measured_chosen_from_and_warned_of(tmp_path, monkeypatch, capsys):
    video = tmp_path / "clip.mp4"
    write_video(video, [view(8 * i) for i in range(NUM_FRAMES)])
    assert gather_images.count_frames(video) == NUM_FRAMES
    assert scan_video(video, lambda done: None)[0][-1] == pytest.approx(29 * 8 / WIDTH, rel=0.1)
    assert gather_images.write_frames(video, [3, 17], tmp_path, 96, lambda done: None) == ["000003.jpg", "000017.jpg"]
    with Image.open(tmp_path / "000017.jpg") as picture:
        assert picture.size == (96, 54)
        shown = np.asarray(picture.convert("L").resize((WIDTH, HEIGHT)), float)
    assert np.abs(shown - view(8 * 17)).mean() < 0.5 * np.abs(shown - view(8 * 9)).mean()
    for announced, said in ((NUM_FRAMES, ""), (100, f"{NUM_FRAMES} of about 100 frames can be read")):
        monkeypatch.setattr(gather_images, "count_frames", lambda path, number=announced: number)
        names = estimate._choose_from_video(video, tmp_path, estimate.PoseOptions(max_frames=3), Reporter(quiet=True))
        warned = capsys.readouterr().err
        assert len(names) == 3 and said in warned and bool(warned) == bool(said)
