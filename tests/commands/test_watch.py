"""`ssplat run --watch`: a folder that grows gives what the finished folder gives."""

import dataclasses
import json
import os
import shutil
import signal
import threading
import time
from types import SimpleNamespace

import jax
import pytest

from ssplat_jax.core.console import Reporter
from ssplat_jax.data.open_capture import is_done
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.runs import watch_run
from ssplat_jax.storage.run_folder import RunFolder
from ssplat_jax.storage.weights import save_weights
from tests.commands.test_cli import few_pivots, make_capture, run  # noqa: F401
from tests.streaming.narrow_model import NARROW

SIZE = (64, 48)


@pytest.fixture
def narrow(tmp_path):
    """Options for a small model."""
    path = tmp_path / "narrow.npz"
    save_weights(path, StreamSplat(NARROW).init(jax.random.key(0)), NARROW, {})
    return ("--weights", str(path), "--quiet")


def write_slowly(whole, growing, pause=0.1):
    """Writes a capture as a camera does: the listing is ahead of the image, images come in two halves."""
    facts = json.loads((whole / "transforms.json").read_text())
    (growing / "images").mkdir(parents=True)
    for i, frame in enumerate(facts["frames"]):
        text = json.dumps(facts | {"frames": facts["frames"][: i + 1]})
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
    for out in outs:  # the scene of another run of as many views, whose state was removed, must not pass for this one's
        out.mkdir()
        (out / "scene.ply").write_bytes(b"of another run")
        (out / "metrics.json").write_text(json.dumps({"views": 10, "ply": {"num_written": 5}}))
        (out / "refined.ply").write_bytes(b"of another run")
    watching = ("--watch", "--quiet-seconds", "60", "--deltas", "--save-every", "1")
    assert run("run", str(growing), "--out", str(outs[1]), *watching, *narrow) == 0
    writer.join()
    assert run("run", str(whole), "--causal", "--deltas", "--out", str(outs[0]), *narrow) == 0
    for name in ("scene.ply", *(f"deltas/{views:06d}.npz" for views in (4, 8, 10))):
        assert (outs[1] / name).read_bytes() == (outs[0] / name).read_bytes(), name
        assert (outs[1] / "report.html").read_text().count("--weights WEIGHTS") == 2
    assert not any((out / "refined.ply").exists() for out in outs)
    # The finished folder is the causal run of the finished capture.
    assert run("run", str(growing), "--causal", "--out", str(outs[1]), *narrow) == 0


@pytest.mark.parametrize("stride", [8, 1])
def test_frames_that_are_only_listed_are_signs_of_life_too(stride, tmp_path, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(watch_run.time, "monotonic", lambda: now[0])
    whole = make_capture(tmp_path / "whole", num_frames=9, size=SIZE)
    if stride == 1:
        (whole / "images" / "1.png").unlink()  # still on its way, while others are listed
    facts = json.loads((whole / "transforms.json").read_text())
    options = watch_run.WatchOptions(stride=stride, quiet_seconds=1.0)
    model = StreamSplat(NARROW)
    watch = watch_run._Watch(model, {}, whole, RunFolder(tmp_path), options, Reporter(quiet=True))
    for count in range(1, 9):
        now[0] += 0.9
        (whole / "transforms.json").write_text(json.dumps(facts | {"frames": facts["frames"][:count]}))
        assert not watch.look() and watch.indices == [0]
    now[0] += 1.1
    assert watch.look()


@dataclasses.dataclass
class Fed:
    """A run that is fed without a model."""

    num_views: int = 0


def watched(whole, tmp_path, monkeypatch, **options):
    """A watch that feeds no model, the run that it feeds, and the sizes of the chunks."""
    monkeypatch.setattr(watch_run, "start_deltas", lambda *given: None)
    monkeypatch.setattr(watch_run.ChunkRecorder, "start", lambda self, run: None)
    monkeypatch.setattr(watch_run._Watch, "_save", lambda self, run: None)
    given = watch_run.WatchOptions(**options)
    watch = watch_run._Watch(StreamSplat(NARROW), {}, whole, RunFolder(tmp_path / "out"), given, Reporter())
    fed, sizes = Fed(), []

    def feed(self, run, group, *more):
        sizes.append(len(group))
        run.num_views += len(group)

    monkeypatch.setattr(watch_run._Watch, "_feed", feed)
    return watch, fed, sizes


def test_frames_that_come_after_the_end_are_for_the_next_call(tmp_path, monkeypatch):
    """Otherwise every later frame would be a chunk of its own, padded."""
    whole = make_capture(tmp_path / "whole", num_frames=8, size=SIZE)
    facts = json.loads((whole / "transforms.json").read_text())
    write = lambda n: (whole / "transforms.json").write_text(json.dumps(facts | {"frames": facts["frames"][:n]}))  # noqa: E731
    write(6)
    watch, fed, sizes = watched(whole, tmp_path, monkeypatch)
    watch.look()
    feed = watch_run._Watch._feed
    monkeypatch.setattr(watch_run._Watch, "_feed", lambda *given: (write(8), feed(*given)))
    watch_run._Watch.stream.__wrapped__(watch, fed, SimpleNamespace(received=None), True)
    assert sizes == [4, 2] and fed.num_views == 6


def test_a_frame_beyond_those_asked_for_is_not_missed(tmp_path, monkeypatch, capsys):
    whole = make_capture(tmp_path / "whole", num_frames=9, size=SIZE)
    (whole / "images" / "8.png").unlink()
    for max_views, words in ((8, ""), (None, "left out")):
        watch, fed, sizes = watched(whole, tmp_path, monkeypatch, max_views=max_views)
        watch.look()
        watch_run._Watch.stream.__wrapped__(watch, fed, SimpleNamespace(received=None), True)
        assert sizes == [4, 4] and words in (told := capsys.readouterr().err) and bool(words) == bool(told)


def test_the_file_done_is_found_from_the_listing_too(tmp_path):
    capture = make_capture(tmp_path / "c", num_frames=2, size=SIZE)
    for path in (capture, capture / "transforms.json"):
        assert not is_done(path)
    (capture / "done").touch()
    for path in (capture, capture / "transforms.json"):
        assert is_done(path)


@pytest.mark.parametrize("command", ["run --watch", "eval --index"])
def test_a_user_that_there_is_not_is_named(command, tmp_path, narrow, capsys):
    (tmp_path / "i.json").write_text('{"a": {"context": [0], "target": [1]}}')
    options = {"run --watch": ("--watch",), "eval --index": ("--index", str(tmp_path / "i.json"))}[command]
    assert run(command.split()[0], "~nosuchuser/c", *options, "--out", str(tmp_path / "out"), *narrow) == 2
    assert "~nosuchuser/c: wanted a path" in capsys.readouterr().err


@pytest.mark.slow
def test_it_ends_after_quiet_seconds_and_goes_on_later(tmp_path, narrow, capsys):
    whole, growing = make_capture(tmp_path / "whole" / "c", num_frames=9, size=SIZE), tmp_path / "growing" / "c"
    shutil.copytree(whole, growing)
    kept = (growing / "images" / "8.png").read_bytes()
    (growing / "images" / "8.png").write_bytes(kept[:100])
    out = tmp_path / "out"
    since = time.monotonic()
    assert run("run", str(growing), "--watch", "--quiet-seconds", "0.5", "--out", str(out), *narrow) == 0
    assert time.monotonic() - since > 0.5
    captured = capsys.readouterr()
    assert "8.png" in captured.err and "left out" in captured.err and "8 views" in captured.out
    (out / "refinement.json").write_text("{}")  # of the scene of 8 views
    (growing / "images" / "8.png").write_bytes(kept)
    (growing / "done").touch()
    assert run("run", str(growing), "--watch", "--out", str(out), *narrow) == 0
    assert "9 views" in capsys.readouterr().out and not (out / "refinement.json").exists()
    straight = tmp_path / "straight"
    assert run("run", str(whole), "--causal", "--out", str(straight), *narrow) == 0
    assert (out / "scene.ply").read_bytes() == (straight / "scene.ply").read_bytes()
    assert run("run", str(growing), "--watch", "--out", str(out), *narrow) == 0
    assert "holds this run, finished" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--watch", "--quiet-seconds", "0.1"), "a frame that can be read"),
        (("--watch", "--quiet-seconds", "0"), "positive time"),
        (("--quiet-seconds", "3"), "--watch beside it"),
    ],
)
def test_a_folder_where_nothing_comes_is_refused(options, words, tmp_path, narrow, capsys):
    out = tmp_path / "out"
    (tmp_path / "empty").mkdir()
    assert run("run", str(tmp_path / "empty"), "--out", str(out), *options, *narrow) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line and not out.exists()


@pytest.mark.parametrize("num_frames", [0, 2])
def test_a_signal_before_the_first_chunk_ends_with_its_code(num_frames, tmp_path, narrow, capsys):
    growing, out = tmp_path / "c", tmp_path / "out"
    growing.mkdir()
    if num_frames:
        growing.rmdir()
        make_capture(growing, num_frames=num_frames, size=SIZE)
    timer = threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGTERM))
    timer.start()
    assert run("run", str(growing), "--watch", "--out", str(out), *narrow) == 128 + signal.SIGTERM
    assert "stopped after 0 views" in capsys.readouterr().err and not out.exists()


def test_frames_that_were_streamed_may_not_change(tmp_path, narrow, capsys):
    """A frame that sorts before the streamed ones would move them."""
    capture, out = make_capture(tmp_path / "c", num_frames=8, size=SIZE), tmp_path / "out"
    (capture / "done").touch()
    out.mkdir()
    RunFolder(out).adjusted_poses.write_text("{")  # left by a run that was stopped before its first save
    assert run("run", str(capture), "--watch", "--out", str(out), *narrow) == 0
    assert not RunFolder(out).adjusted_poses.exists()
    facts = json.loads((capture / "transforms.json").read_text())
    facts["frames"][2]["transform_matrix"][0][3] += 0.01
    (capture / "transforms.json").write_text(json.dumps(facts))
    capsys.readouterr()
    assert run("run", str(capture), "--watch", "--out", str(out), *narrow) == 2
    assert "differs in its poses" in capsys.readouterr().err
