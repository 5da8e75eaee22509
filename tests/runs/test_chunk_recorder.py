"""Records of chunks, and frames that a run holds back."""

import json

import numpy as np
import pytest

from ssplat_jax.core.errors import InputError
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.runs.chunk_recorder import CHUNKS_PER_SCORE, hold_back
from ssplat_jax.storage.chunk_records import (
    THUMBNAIL_SIDE,
    load_chunk_records,
    make_thumbnail,
    open_thumbnail,
    save_chunk_record,
)
from ssplat_jax.storage.run_folder import RunFolder
from tests.commands.test_cli import make_capture, run
from tests.runs.test_reports import record, smooth_picture


@pytest.fixture(autouse=True)
def small(compiled_plainly, monkeypatch):
    monkeypatch.setattr("ssplat_jax.streaming.session.MIN_DECODED_PIVOTS", 1 << 11)


def test_held_back_frames_are_spread_and_the_others_stay_in_order():
    streamed, held = hold_back(range(0, 40, 2), 3)
    assert held == [6, 20, 32] and streamed == [i for i in range(0, 40, 2) if i not in held]
    assert hold_back([4, 5, 6], 0) == ([4, 5, 6], []) and hold_back([4, 5, 6], 1) == ([4, 6], [5])
    assert hold_back([4], 0) == ([4], []) and hold_back([], 0) == ([], [])
    for count in range(1, 19):
        assert len(hold_back(range(20), count)[1]) == count


@pytest.mark.parametrize("count", [-1, 3, 100])
def test_a_run_cannot_hold_back_what_it_needs(count):
    with pytest.raises(InputError, match="--hold-back: wanted 0 to 2 of the 4 frames"):
        hold_back(range(4), count)


def test_a_record_is_read_as_it_was_written_up_to_a_damaged_one(tmp_path):
    folder = RunFolder(tmp_path)
    for k in (4, 8, 12):
        save_chunk_record(folder.chunk_record(k), record(k, 20.0))
    for name in ("notes.json", "._000004.json", "0000041.json"):  # of the user, or of another system
        (folder.chunk_records / name).write_text("{}")
        (folder.deltas).mkdir(exist_ok=True)
        (folder.deltas / name).with_suffix(".npz").write_bytes(b"")
    assert not folder.has_deltas()
    found = load_chunk_records(folder.chunk_record_files())
    assert [r.num_views for r in found] == [4, 8, 12]
    assert found[1].to_dict() == record(8, 20.0).to_dict()
    for damage in ("{", "[]", "{}", json.dumps(record(8).to_dict() | {"kind": "other"}), "null"):
        folder.chunk_record(8).write_text(damage)
        assert [r.num_views for r in load_chunk_records(folder.chunk_record_files())] == [4]


def test_a_thumbnail_is_the_picture_made_small():
    small = open_thumbnail(make_thumbnail(smooth_picture(1, height=240, width=640)))
    assert small.shape == (60, THUMBNAIL_SIDE, 3)
    wanted = smooth_picture(1, height=240, width=640).reshape(60, 4, 160, 4, 3).mean(axis=(1, 3))
    assert np.abs(small / 255 - wanted).mean() < 0.02


def test_a_run_records_its_chunks_and_scores_what_it_holds_back(tmp_path, capsys):
    path = make_capture(tmp_path / "capture", num_frames=11)
    out = tmp_path / "out"
    arguments = (str(path), "--out", str(out), "--hold-back", "2", "--quiet", "--set", "capacity=2048")
    assert run("run", *arguments) == 0
    assert f"{out}/report.html" in capsys.readouterr().out
    capture, folder = open_capture(path), RunFolder(out)
    records = load_chunk_records(folder.chunk_record_files())
    assert [r.num_views for r in records] == [4, 8, 9]
    streamed, _ = hold_back(range(11), 2)
    views = [view for r in records for view in r.views]
    assert sorted(view.frame for view in views) == streamed
    exposures = json.loads(folder.metrics.read_text())["exposures"]
    for view in views:
        np.testing.assert_array_equal(view.camtoworld, capture.frames[view.frame].camtoworld)
        np.testing.assert_array_equal(view.K, capture.K(view.frame))
        np.testing.assert_allclose(view.exposure, exposures[str(view.frame)])
        assert np.abs(open_thumbnail(view.thumbnail) / 255 - capture.image(view.frame)).mean() < 0.1  # JPEG of noise
    assert records[-1].num_gaussians == json.loads(folder.metrics.read_text())["cache"]["decoded"]
    assert 0 < records[0].occupancy <= records[-1].occupancy <= 1 and all(r.seconds > 0 for r in records)
    scored = [r.held_back_psnr is not None for r in records]
    assert CHUNKS_PER_SCORE == 4 and scored == [True, False, True]
    assert f"{records[-1].held_back_psnr:.2f} dB" in folder.report.read_text()
    # What an interrupted run recorded beyond its saved state goes; a new run removes all.
    save_chunk_record(folder.chunk_record(40), record(40))
    folder.metrics.unlink()
    assert run("run", *arguments) == 0
    assert [path.stem for path in folder.chunk_record_files()] == ["000004", "000008", "000009"]
    folder.clear_run()
    assert not folder.chunk_records.exists() and not folder.report.exists()


def test_a_growing_capture_cannot_hold_frames_back(tmp_path, capsys):
    assert run("run", str(tmp_path), "--watch", "--hold-back", "2", "--out", str(tmp_path / "out")) == 2
    assert "--hold-back" in capsys.readouterr().err
