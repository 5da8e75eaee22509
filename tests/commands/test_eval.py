"""`ssplat eval`: the frames that it chooses, index files in and out, means over views and scenes, flags of pictures."""

import hashlib
import json

import pytest
from PIL import Image

from ssplat_jax.data.split import choose_split, index_to_json, read_index
from ssplat_jax.evaluation import cost
from ssplat_jax.runs import evaluate_run
from ssplat_jax.runs.evaluate_run import index_of_folder
from ssplat_jax.runs.stream_commands import Eval
from tests.commands.command_fixture import SIZE, make_capture, read, run
from tests.streaming.narrow_model import FEW_GAUSSIANS


@pytest.fixture(autouse=True)
def timed_once(monkeypatch):
    monkeypatch.setattr(cost, "NUM_REPEATS", 1)


def test_scenes_of_an_index_are_averaged_by_scene_and_by_view(tmp_path, narrow, monkeypatch):
    made_room = []
    scored = lambda: made_room.append(len(list(out.glob("*/metrics.json"))))  # noqa: E731
    monkeypatch.setattr(evaluate_run, "make_room", scored)
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
    assert metrics["peak_memory_bytes"] == max(a["peak_memory_bytes"], b["peak_memory_bytes"])


def test_a_scene_without_memory_is_a_row_and_the_others_are_scored(tmp_path, monkeypatch, capsys):
    def evaluate(session, capture, split, out, reporter, **_):
        if capture.name == "a":
            raise RuntimeError(cause)
        return {"literal": one, "shown": one, "target_views": 2, "peak_memory_bytes": 7}

    one, out, cause = {"psnr": 9.0, "ssim": 0.5, "lpips": None}, tmp_path / "out", "RESOURCE_EXHAUSTED: 9 GiB"
    monkeypatch.setattr(evaluate_run, "evaluate", evaluate)
    monkeypatch.setattr(evaluate_run, "report_eval", lambda *_: None)
    for name in ("a", "b"):
        make_capture(tmp_path / "scenes" / name, num_frames=12, size=SIZE)
    assert run("eval", str(tmp_path / "scenes"), "--context", "8", "--out", str(out)) == 0
    metrics, (words, _) = read(out / "metrics.json"), capsys.readouterr()
    assert metrics["scenes"]["a"]["peak_memory_bytes"] == metrics["peak_memory_bytes"] == "OOM"
    assert metrics["scenes"]["b"]["literal"] == one and metrics["over_scenes"] is metrics["over_views"] is None
    assert "out of memory" in words
    cause = "a mistake of ours"
    with pytest.raises(RuntimeError, match=cause):
        run("eval", str(tmp_path / "scenes"), "--context", "8", "--out", str(tmp_path / "again"))


def test_a_folder_of_scenes_without_an_index_gets_one_by_the_protocol(tmp_path):
    """The index reads as those that are published; a scene that is too short is null."""
    for name, num_frames in (("a", 12), ("b", 9), ("c", 5)):
        make_capture(tmp_path / "scenes" / name, num_frames=num_frames, size=SIZE)
    (tmp_path / "scenes" / "notes").mkdir()
    options = Eval(str(tmp_path / "scenes"), tmp_path / "out", protocol="paper", context=6, targets=3)
    index, (note,) = index_of_folder(options)
    assert list(index) == ["a", "b", "c"] and index["c"] is None and note.startswith("c: left out (")
    for name, num_frames in (("a", 12), ("b", 9)):
        assert index[name] == choose_split("paper", num_frames, None, 6, 3)
    (tmp_path / "index.json").write_text(json.dumps(index_to_json(index)))
    again, _ = read_index(tmp_path / "index.json")
    assert index_to_json(again) == index_to_json(index)


@pytest.mark.slow
def test_an_evaluation_refines_at_the_streamed_size_and_scores_at_the_captures(tmp_path, narrow):
    capture, out = make_capture(tmp_path / "capture", num_frames=12, size=(128, 96)), tmp_path / "eval"
    assert run("eval", capture, "--context", "8", "--quality", "fast", "--refine", "3", "--out", out, *narrow) == 0
    metrics = read(out / "metrics.json")
    assert metrics["peak_memory_bytes"] >= metrics["step_memory_bytes"] > 0
    assert metrics["context_views"] == 8 and metrics["target_views"] == len(metrics["per_view"]) == 1
    most, decoded = FEW_GAUSSIANS.head.gaussians_per_token * metrics["cache"]["pivots"], metrics["cache"]["decoded"]
    assert most >= decoded >= metrics["num_gaussians"] > 0
    assert hashlib.sha256((out / "split.json").read_bytes()).hexdigest() == metrics["split_sha256"]
    # Streamed at half the size, scored at the whole.
    assert (metrics["streamed_size"], metrics["size"]) == ([64, 48], [128, 96])
    with Image.open(out / "view_00004.png") as picture:
        assert picture.size == (3 * 128, 96)
    refinement = metrics["refinement"]
    assert refinement["num_steps"] == 3 and refinement["num_skipped"] == 0
    assert all(0 < abs(metrics[name]["psnr"] - refinement["before"][name]["psnr"]) < 3 for name in ("literal", "shown"))
