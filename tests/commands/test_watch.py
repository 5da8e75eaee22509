"""`ssplat run --watch`: a folder that grows gives what the finished folder gives."""

import os
import shutil
import signal
import threading
import time

import pytest

from ssplat_jax.core.console import Reporter
from ssplat_jax.runs import capture_run
from ssplat_jax.runs.capture_run import GrowingCapture
from ssplat_jax.runs.stream_commands import Run
from ssplat_jax.storage.files import write_json
from tests.commands.command_fixture import SIZE, edit, make_capture, read, run


def list_frames(folder, whole, count):
    """The listing of `whole` as it was after `count` frames."""
    facts = read(whole / "transforms.json")
    write_json(folder / "transforms.json", facts | {"frames": facts["frames"][:count]})


def write_slowly(whole, growing, pause=0.05):
    """Writes a capture as a camera does: the listing is ahead of the image, images come in two halves."""
    (growing / "images").mkdir(parents=True)
    for i, frame in enumerate(read(whole / "transforms.json")["frames"]):
        list_frames(growing, whole, i + 1)
        text = (growing / "transforms.json").read_text()
        (growing / "transforms.json").write_text(text[: len(text) // 2])
        time.sleep(pause / 4)
        (growing / "transforms.json").write_text(text)
        time.sleep(pause / 4)
        pixels = (whole / frame["file_path"]).read_bytes()
        (growing / frame["file_path"]).write_bytes(pixels[: len(pixels) // 2])
        time.sleep(pause / 2)
        (growing / frame["file_path"]).write_bytes(pixels)
    (growing / "done").touch()


def test_a_growing_folder_gives_the_scene_of_the_whole_one(tmp_path, narrow):
    whole = make_capture(tmp_path / "whole" / "capture", num_frames=10, size=SIZE)
    growing = tmp_path / "growing" / "capture"
    writer = threading.Thread(target=write_slowly, args=(whole, growing))
    writer.start()
    outs = tmp_path / "straight", tmp_path / "watched"
    watching = ("--watch", "--quiet-seconds", "60", "--deltas", "--save-every", "1")
    assert run("run", growing, "--out", outs[1], *watching, *narrow) == 0
    writer.join()
    assert run("run", whole, "--causal", "--deltas", "--out", outs[0], *narrow) == 0
    for name in ("scene.ply", *(f"deltas/{views:06d}.npz" for views in (4, 8, 10))):
        assert (outs[1] / name).read_bytes() == (outs[0] / name).read_bytes(), name
    # The finished folder is the causal run of the finished capture, which may not change afterwards.
    assert run("run", growing, "--causal", "--out", outs[1], *narrow) == 0
    edit("transform_matrix", [[1, 0, 0, 0.01], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])(growing)
    assert run("run", growing, "--watch", "--out", outs[1], *narrow) == 2


def growing_capture(path, **options):
    return GrowingCapture(Run(str(path), path, quiet_seconds=1.0, **options), Reporter())


@pytest.mark.parametrize(("stride", "comes"), [(8, "the listing"), (1, "the listing"), (8, "the images")])
def test_frames_that_are_not_streamed_are_signs_of_life_too(stride, comes, tmp_path, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(capture_run.time, "monotonic", lambda: now[0])
    whole, growing = make_capture(tmp_path / "whole", num_frames=9, size=SIZE), tmp_path / "growing"
    shutil.copytree(whole, growing)
    if stride == 1:
        (growing / "images" / "1.png").unlink()  # still on its way, while others are listed
    if comes == "the images":
        for i in range(1, 9):
            (growing / "images" / f"{i}.png").unlink()
    watched = growing_capture(growing, stride=stride)
    for count in range(1, 9):
        now[0] += 0.9
        if comes == "the listing":
            list_frames(growing, whole, count)
        elif count < 8:
            shutil.copy(whole / "images" / f"{count}.png", growing / "images")
        watched.look()
        assert not watched.has_ended and watched.indices == [0]
    now[0] += 1.1
    watched.look()
    assert watched.has_ended


class Stream:
    """A run that is fed without a model."""

    def __init__(self, monkeypatch):
        self.num_views, self.sizes, self.stream_frame, self.session = 0, [], None, self
        self.model, self.config, self.stream, self.chunk_size, self.received = self, self, self, 4, None
        monkeypatch.setattr(capture_run, "feed_chunks", self.feed)

    def feed(self, session, capture, group, frame):
        self.sizes.append(len(group))
        self.num_views += len(group)
        yield len(group)


def test_a_frame_beyond_those_asked_for_is_not_missed(tmp_path, monkeypatch, capsys):
    whole = make_capture(tmp_path / "whole", num_frames=9, size=SIZE)
    (whole / "images" / "8.png").unlink()
    (whole / "done").touch()
    for path, max_views, words in ((whole, 8, ""), (whole / "transforms.json", None, "left out")):
        watched, stream = growing_capture(path, max_views=max_views), Stream(monkeypatch)
        watched.look()
        assert watched.has_ended
        assert list(watched.chunks.__wrapped__(watched, stream, stream)) == [4, 4]
        assert words in (told := capsys.readouterr().err) and bool(words) == bool(told)


def test_a_signal_before_the_first_chunk_ends_with_its_code(tmp_path, narrow, capsys):
    growing, out = make_capture(tmp_path / "c", num_frames=2, size=SIZE), tmp_path / "out"
    threading.Timer(0.7, os.kill, (os.getpid(), signal.SIGTERM)).start()
    assert run("run", growing, "--watch", "--out", out, *narrow) == 128 + signal.SIGTERM
    assert "stopped after 0 views" in capsys.readouterr().err and not out.exists()
