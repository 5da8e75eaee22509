"""Copies of photos: upright, of bounded size, with their focal length, under names without spaces."""

import numpy as np
import pytest
from PIL import Image

from ssplat_jax.errors import InputError
from ssplat_jax.poses.photos import copy_photos, list_photos

FOCAL_LENGTH_35MM, EXIF_BLOCK, ORIENTATION = 0xA405, 0x8769, 274


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
