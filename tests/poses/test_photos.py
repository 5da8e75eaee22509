"""Copies of photos: upright, of bounded size, with their focal length, under names without spaces."""

import os

import numpy as np
import pytest
from PIL import Image, ImageOps

from ssplat_jax.core.errors import InputError
from ssplat_jax.poses.photos import copy_photos, list_photos

FOCAL_LENGTH_35MM, EXIF_BLOCK, ORIENTATION, MAKE, EDITOR = 0xA405, 0x8769, 274, 271, 37724


def save(path, size=(40, 30), orientation=None):
    path.parent.mkdir(parents=True, exist_ok=True)
    picture = Image.new("RGB", size)
    picture.paste((200, 30, 30), (0, 0, size[0] // 2, size[1] // 2))  # the stored upper left is red
    exif = Image.Exif()
    if orientation:
        exif[ORIENTATION] = orientation
    exif.get_ifd(EXIF_BLOCK)[FOCAL_LENGTH_35MM] = 26
    picture.save(path, quality=95, exif=exif)


def copy(tmp_path, max_side=1600):
    (tmp_path / "out").mkdir(exist_ok=True)
    return copy_photos(list_photos(tmp_path / "in"), tmp_path / "out", max_side, lambda done: None)


def test_upright_photos_are_copied_as_they_are(tmp_path):
    for name in ("10.jpg", "9.jpg", "b 1.png"):
        save(tmp_path / "in" / name)
    (tmp_path / "in" / "note.txt").write_text("no photo")
    assert copy(tmp_path) == ["9.jpg", "10.jpg", "b_1.png"]  # in natural order, without spaces
    assert (tmp_path / "out" / "9.jpg").read_bytes() == (tmp_path / "in" / "9.jpg").read_bytes()


def test_photos_on_their_side_are_turned_and_keep_the_focal_length(tmp_path):
    save(tmp_path / "in" / "1.jpg", orientation=6)  # to be turned clockwise: the upper left goes to the upper right
    save(tmp_path / "in" / "2.jpg", size=(400, 300))
    assert copy(tmp_path, max_side=100) == ["1.jpg", "2.jpg"]
    with Image.open(tmp_path / "out" / "1.jpg") as turned, Image.open(tmp_path / "out" / "2.jpg") as small:
        assert turned.size == (30, 40) and small.size == (100, 75)
        pixels = np.asarray(turned, int)
        assert pixels[5, 25, 0] > 150 and pixels[5, 5, 0] < 50
        for picture in (turned, small):
            exif = picture.getexif()
            assert exif.get(ORIENTATION, 1) == 1 and exif.get_ifd(EXIF_BLOCK)[FOCAL_LENGTH_35MM] == 26


def test_photos_may_lie_in_images(tmp_path):
    save(tmp_path / "images" / "a.jpg")
    save(tmp_path / "images" / "b.jpg")
    assert [photo.name for photo in list_photos(tmp_path)] == ["a.jpg", "b.jpg"]


def test_unusable_photos_are_refused_by_name(tmp_path):
    with pytest.raises(InputError, match="fewer than two images"):
        list_photos(tmp_path)
    (tmp_path / "IMG_1.HEIC").write_bytes(b"x")
    with pytest.raises(InputError, match=r"1 HEIC files.*JPEG"):
        list_photos(tmp_path)
    save(tmp_path / "in" / "a b.jpg")
    save(tmp_path / "in" / "a_b.jpg")
    with pytest.raises(InputError, match=r"'a_b\.jpg' twice"):
        copy(tmp_path)
    (tmp_path / "in" / "a_b.jpg").unlink()
    save(tmp_path / "in" / "c.jpg", size=(400, 300))
    whole = (tmp_path / "in" / "c.jpg").read_bytes()
    (tmp_path / "in" / "c.jpg").write_bytes(whole[: len(whole) * 2 // 3])
    with pytest.raises(InputError, match=r"c\.jpg.*damaged data"):
        copy(tmp_path)


def test_photos_beside_unreadable_ones_must_be_their_copies(tmp_path):
    for name in ("1.jpg", "2.JPG", "3.png"):
        save(tmp_path / name)
    for name in ("1.heic", "4.HEIC", "5.heif"):
        (tmp_path / name).write_bytes(b"x")
    with pytest.raises(InputError, match="2 HEIC files beside 3 others; convert"):
        list_photos(tmp_path)
    for name in ("4.jpg", "5.jpg"):
        save(tmp_path / name)
    assert [photo.name for photo in list_photos(tmp_path)] == ["1.jpg", "2.JPG", "3.png", "4.jpg", "5.jpg"]


def test_reduced_gray_of_16_bits_keeps_its_mean(tmp_path):
    ramp = np.tile(np.linspace(0, 65535, 400).astype(np.uint16), (300, 1))
    (tmp_path / "in").mkdir()
    for name in ("1.png", "2.tif"):
        Image.fromarray(ramp).save(tmp_path / "in" / name)
    for name in copy(tmp_path, max_side=100):
        with Image.open(tmp_path / "out" / name) as picture:
            assert picture.size == (100, 75)
            assert np.asarray(picture).mean() / 255 == pytest.approx(0.5, abs=0.02)


def test_exif_data_too_long_for_a_jpeg_keep_the_focal_length(tmp_path):
    """A TIFF's tags are all EXIF data, such as those of an editor, which no JPEG file has room for."""
    exif = Image.Exif()
    exif[MAKE], exif[EDITOR] = "Maker", b"x" * 70_000
    exif.get_ifd(EXIF_BLOCK)[FOCAL_LENGTH_35MM] = 26
    (tmp_path / "in").mkdir()
    for name in ("1.png", "2.png"):
        Image.new("RGB", (400, 300)).save(tmp_path / "in" / name, exif=exif)
    assert copy(tmp_path, max_side=100) == ["1.jpg", "2.jpg"]
    with Image.open(tmp_path / "out" / "1.jpg") as picture:
        kept = picture.getexif()
        assert kept[MAKE] == "Maker" and EDITOR not in kept
        assert kept.get_ifd(EXIF_BLOCK)[FOCAL_LENGTH_35MM] == 26


def test_names_that_colmap_cannot_list_get_underscores(tmp_path):
    for name in ("#1 a.jpg", os.fsdecode(b"\xe9.jpg"), "b#.jpg"):
        save(tmp_path / "in" / name)
    assert sorted(copy(tmp_path)) == ["_.jpg", "_1_a.jpg", "b#.jpg"]


@pytest.mark.parametrize("exif", [b"Exif\0\0MM\0\0\0\0\0\x08", b"Exif\0\0MM\0*\0\0"], ids=["no TIFF", "cut off"])
def test_large_photos_with_malformed_exif_data_are_reduced(exif, tmp_path):
    (tmp_path / "in").mkdir()
    for name in ("1.jpg", "2.jpg"):
        Image.new("RGB", (400, 300), (200, 30, 30)).save(tmp_path / "in" / name, exif=exif)
    assert copy(tmp_path, max_side=100) == ["1.jpg", "2.jpg"]
    with Image.open(tmp_path / "out" / "1.jpg") as picture:
        assert picture.size == (100, 75) and abs(np.asarray(picture)[0, 0, 0] - 200.0) < 5


@pytest.mark.parametrize("orientation", range(1, 9))
def test_reduced_photos_are_upright_even_if_their_exif_data_cannot_be_written(orientation, tmp_path, monkeypatch):
    """Pillow's own transposition, which needs to write the data, is the reference."""
    (tmp_path / "in").mkdir()
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    quarters = np.kron([[0, 80], [160, 240]], np.ones((30, 40))).astype(np.uint8)
    for name in ("1.png", "2.png"):
        Image.fromarray(quarters).save(tmp_path / "in" / name, exif=exif)
    with Image.open(tmp_path / "in" / "1.png") as picture:
        wanted = np.asarray(ImageOps.exif_transpose(picture))

    def broken(self, *given):
        raise TypeError("a tag of another type")

    monkeypatch.setattr(Image.Exif, "tobytes", broken)
    assert copy(tmp_path, max_side=79) == ["1.jpg", "2.jpg"]
    with Image.open(tmp_path / "out" / "1.jpg") as picture:
        found = np.asarray(picture.convert("L").resize(wanted.shape[::-1]), np.float64)
    assert np.median(np.abs(found - wanted)) < 3
