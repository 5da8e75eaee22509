"""`ssplat eval`: the frames that it chooses, index files in and out, means over views and scenes, flags of pictures."""

import json
import math

import jax
import numpy as np
import pytest
from PIL import Image

from ssplat_jax.evaluation import cost
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.runs import eval_run
from ssplat_jax.runs.eval_run import scene_metrics
from ssplat_jax.storage.weights import save_weights
from tests.commands.test_cli import few_pivots, make_capture, run  # noqa: F401
from tests.streaming.narrow_model import NARROW

SIZE = (64, 48)


@pytest.fixture(autouse=True)
def timed_once(monkeypatch):
    monkeypatch.setattr(cost, "NUM_REPEATS", 1)


@pytest.fixture
def narrow(tmp_path):
    """Options for a small model."""
    path = tmp_path / "narrow.npz"
    save_weights(path, StreamSplat(NARROW).init(jax.random.key(0)), NARROW, {})
    return ("--weights", str(path), "--quiet")


def read(path):
    return json.loads(path.read_text())


@pytest.mark.slow
def test_a_short_capture_needs_no_option(tmp_path, narrow):
    capture, out = make_capture(tmp_path / "capture", num_frames=7, size=SIZE), tmp_path / "out"
    assert run("eval", str(capture), "--out", str(out), *narrow) == 0
    assert read(out / "index.json") == {"capture": {"context": [0, 1, 2, 3, 5, 6], "target": [4]}}
    again = tmp_path / "again"
    assert run("eval", str(capture), "--index", str(out / "index.json"), "--out", str(again), *narrow) == 0
    first, second = (read(folder / "metrics.json") for folder in (out, again))
    assert (first["shown"], first["literal"]) == (second["shown"], second["literal"])
    assert second["protocol"] == "index"


def test_an_index_sets_the_order_of_the_stream(tmp_path, narrow, monkeypatch):
    order = []
    monkeypatch.setattr("ssplat_jax.data.capture.Capture._views", spied(order))
    capture, out = make_capture(tmp_path / "capture", num_frames=9, size=SIZE), tmp_path / "out"
    index = tmp_path / "index.json"
    index.write_text(json.dumps({"own name": {"context": [8, 0, 4, 2, 6], "target": [3]}}))
    arguments = ("eval", str(capture), "--index", str(index), "--scene", "own name", "--out", str(out))
    assert run(*arguments, *narrow, "--set", "chunk_step=10.0") == 0  # a step that would interleave everything
    assert order == [[8, 0, 4, 2], [6]]
    assert read(out / "index.json") == read(index)


def spied(order):
    from ssplat_jax.data.capture import Capture

    views = Capture._views

    def spy(self, group, chunk_size, frame):
        order.append(list(group))
        return views(self, group, chunk_size, frame)

    return spy


def test_scenes_of_an_index_are_averaged_by_scene_and_by_view(tmp_path, narrow, monkeypatch):
    made_room = []
    scored = lambda: made_room.append(len(list(out.glob("*/metrics.json"))))  # noqa: E731
    monkeypatch.setattr(eval_run, "make_room", scored)
    scenes, out = tmp_path / "scenes", tmp_path / "out"
    for name in ("a", "b"):
        make_capture(scenes / name, num_frames=8, size=SIZE)
    index = tmp_path / "index.json"
    index.write_text(json.dumps({
        "a": {"context": [0, 2, 4, 6], "target": [1]},
        "b": {"context": [0, 3, 5, 7], "target": [1, 2, 4]},
        "c": None,
    }))  # fmt: skip
    assert run("eval", str(scenes), "--index", str(index), "--out", str(out), *narrow) == 0
    assert made_room == [0, 1]  # before each scene: programs of many would be too many for one process
    metrics, a, b = (read(out / name / "metrics.json") for name in ("", "a", "b"))
    assert metrics["left_out"] == ["c"] and read(out / "index.json") == read(index)
    for name in ("literal", "shown"):
        one, two = a[name]["psnr"], b[name]["psnr"]
        assert one != two
        assert metrics["over_scenes"][name]["psnr"] == pytest.approx((one + two) / 2, abs=1e-4)
        assert metrics["over_views"][name]["psnr"] == pytest.approx((one + 3 * two) / 4, abs=1e-4)
    assert metrics["scenes"]["b"]["target_views"] == 3


def test_a_mean_without_lpips_everywhere_is_none():
    block = {"psnr": 20.0, "ssim": 0.5, "lpips": 0.1}
    scene = {"literal": block, "shown": block, "psnr_over_black": 1.0, "psnr_one_exposure": 2.0, "target_views": 1}
    both = scene_metrics({"a": scene, "b": scene | {"shown": block | {"lpips": None}}})
    assert both["over_scenes"]["literal"]["lpips"] == 0.1 and both["over_scenes"]["shown"]["lpips"] is None


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--index", "INDEX", "--context", "4"), "--context too"),
        (("--index", "INDEX", "--protocol", "paper"), "--protocol too"),
        (("--index", "INDEX"), "'capture'"),
        (("--scene", "a"), "--index beside it"),
        (("--protocol", "scannet"), "64 targets"),
    ],
)
def test_contradictory_frames_are_bad_usage(options, words, tmp_path, narrow, capsys):
    capture, out = make_capture(tmp_path / "capture", num_frames=7, size=SIZE), tmp_path / "out"
    (tmp_path / "index.json").write_text('{"a": {"context": [0], "target": [1]}}')
    options = [str(tmp_path / "index.json") if option == "INDEX" else option for option in options]
    assert run("eval", str(capture), "--out", str(out), *options, *narrow) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line.replace('"', "'") and not out.exists()


def test_an_index_cannot_lead_out_of_its_folder(tmp_path, narrow, capsys):
    make_capture(tmp_path / "scenes" / "a", size=SIZE)
    (tmp_path / "index.json").write_text('{"../b": {"context": [0], "target": [1]}}')
    arguments = ("--index", str(tmp_path / "index.json"), "--out", str(tmp_path / "out"))
    assert run("eval", str(tmp_path / "scenes"), *arguments, *narrow) == 2
    assert "../b" in capsys.readouterr().err and not (tmp_path / "out").exists()


def picture_psnr(path):
    """PSNR of the middle third of a picture, the render, against the left one, the target."""
    pixels = np.asarray(Image.open(path), np.float64) / 255
    target, rendered = pixels[:, : SIZE[0]], pixels[:, SIZE[0] : 2 * SIZE[0]]
    return -10 * math.log10(np.mean((target - rendered) ** 2))


@pytest.mark.slow
def test_pictures_show_what_their_flags_say(tmp_path, narrow):
    """Pictures of 8 bits have the PSNR that the metrics give for their flags."""
    capture, seen = make_capture(tmp_path / "capture", num_frames=7, size=SIZE), set()
    for flags in ((), ("--over-black",), ("--one-exposure",), ("--over-black", "--one-exposure")):
        out = tmp_path / "-".join(("out", *flags))
        assert run("eval", str(capture), "--out", str(out), *flags, *narrow) == 0
        metrics = read(out / "metrics.json")
        scores = {
            (): metrics["shown"]["psnr"],
            ("--over-black",): metrics["psnr_over_black"],
            ("--one-exposure",): metrics["psnr_one_exposure"],
            ("--over-black", "--one-exposure"): metrics["literal"]["psnr"],
        }
        assert metrics["pictures"]["psnr"] == scores[flags]
        assert picture_psnr(out / "view_00004.png") == pytest.approx(scores[flags], abs=0.05)
        seen.add(scores[flags])
    assert len(seen) > 1
