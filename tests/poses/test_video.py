"""Videos: frames are measured, chosen and written upright."""

from fractions import Fraction

import numpy as np
import pytest
from PIL import Image

from ssplat_jax.core.console import Reporter
from ssplat_jax.core.errors import InputError
from ssplat_jax.poses import estimate
from ssplat_jax.poses.video import count_frames, quarter_turns, scan_video, write_frames

av = pytest.importorskip("av", reason="videos need PyAV: pip install -e '.[poses]'")

WIDTH, HEIGHT, NUM_FRAMES = 320, 180, 30
WALL = np.random.default_rng(0).integers(0, 255, (HEIGHT // 4, 200, 3), dtype=np.uint8).repeat(4, 0).repeat(4, 1)


def write_video(path, images, rate=10):
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", Fraction(rate), options={"crf": "10"})
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")))
        container.mux(stream.encode())


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    """Ten frames at rest, then eight pixels a frame."""
    path = tmp_path_factory.mktemp("video") / "clip.mp4"
    starts = [8 * max(i - 10, 0) for i in range(NUM_FRAMES)]
    write_video(path, [WALL[:, x : x + WIDTH] for x in starts])
    return path


def test_motion_of_a_video_is_that_of_its_pictures(video):
    steps = []
    scan = scan_video(video, steps.append)
    assert count_frames(video) == NUM_FRAMES and steps == list(range(1, NUM_FRAMES + 1))
    assert scan.motion[10] < 0.01
    assert scan.motion[-1] == pytest.approx(19 * 8 / WIDTH, rel=0.1)
    assert (scan.sharpnesses > 0).all()


def test_chosen_frames_are_written_by_number(video, tmp_path):
    assert write_frames(video, [3, 17, 29], tmp_path, 1600, lambda done: None) == [
        "000003.jpg",
        "000017.jpg",
        "000029.jpg",
    ]
    with Image.open(tmp_path / "000017.jpg") as picture:
        assert picture.size == (WIDTH, HEIGHT)
        difference = np.asarray(picture, float) - WALL[:, 8 * 7 : 8 * 7 + WIDTH]
        other = np.asarray(picture, float) - WALL[:, :WIDTH]
    # Color is stored at half the resolution, so cells of other colors bleed; gray does not.
    assert np.abs(difference.mean(-1)).mean() < 8 < np.abs(other.mean(-1)).mean()
    write_frames(video, [0], tmp_path, 160, lambda done: None)
    with Image.open(tmp_path / "000000.jpg") as picture:
        assert picture.size == (160, 90)


def test_phones_held_upright_ask_for_a_turn():
    """A file that asks for -90 degrees is shown turned clockwise: its first row becomes the last column."""
    picture = np.array([[1, 2], [3, 4]])
    np.testing.assert_array_equal(np.rot90(picture, quarter_turns(-90)), [[3, 1], [4, 2]])
    np.testing.assert_array_equal(np.rot90(picture, quarter_turns(180)), [[4, 3], [2, 1]])
    assert quarter_turns(0) == 0


def test_a_recording_that_was_cut_off_is_read_as_far_as_it_goes(video, tmp_path):
    whole = tmp_path / "whole.ts"  # a format that needs no index at its end
    write_video(whole, [WALL[:, 8 * i : 8 * i + WIDTH] for i in range(NUM_FRAMES)])
    data = whole.read_bytes()
    (tmp_path / "cut.ts").write_bytes(data[: len(data) * 2 // 3])
    assert 2 <= len(scan_video(tmp_path / "cut.ts", lambda n: None).motion) < NUM_FRAMES


def test_a_video_that_ends_early_is_warned_of(video, tmp_path, monkeypatch, capsys):
    for announced, said in ((NUM_FRAMES, ""), (100, f"{NUM_FRAMES} of about 100 frames can be read")):
        monkeypatch.setattr(estimate, "count_frames", lambda path, number=announced: number)
        names = estimate._choose_from_video(video, tmp_path, estimate.PoseOptions(max_frames=3), Reporter(quiet=True))
        assert len(names) == 3
        warned = capsys.readouterr().err
        assert said in warned and bool(warned) == bool(said)


def test_files_without_moving_pictures_are_refused(tmp_path):
    with av.open(str(tmp_path / "sound.mp4"), "w") as container:
        stream = container.add_stream("aac", rate=44100)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
        frame.sample_rate = 44100
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    with pytest.raises(InputError, match=r"sound\.mp4.*without pictures"):
        scan_video(tmp_path / "sound.mp4", lambda n: None)
