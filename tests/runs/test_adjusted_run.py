"""A run with adjusted poses: found once, kept in its folder, used by all that follows."""

import dataclasses
import json

import numpy as np
import pytest

from ssplat_jax.config import preset
from ssplat_jax.core.console import Reporter
from ssplat_jax.core.errors import InputError, StorageError
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.poses import adjust_poses as adjusting
from ssplat_jax.poses.adjust_poses import AdjustedPoses
from ssplat_jax.runs import render_scene
from ssplat_jax.runs.capture_run import run_capture
from ssplat_jax.runs.export_cameras import open_cameras
from ssplat_jax.runs.refine_run import refine_run
from ssplat_jax.runs.run_poses import (
    capture_to_stream,
    has_adjusted_poses,
    open_capture_of_scene,
    with_poses_of_run,
)
from ssplat_jax.storage.run_folder import RunFolder
from ssplat_jax.storage.weights import load_params

CAPTURE, SIZE = "procedural:room?frames=4", (64, 48)
SHIFT = np.array([0.01, 0.0, 0.02])


def moved(capture, indices, advance=None, are_off=True):
    """An adjustment that moves every frame by the same shift."""
    frames = list(capture.frames)
    for i in indices:
        pose = frames[i].camtoworld.copy()
        pose[:3, 3] += SHIFT
        frames[i] = dataclasses.replace(frames[i], camtoworld=pose)
    return AdjustedPoses(dataclasses.replace(capture, frames=tuple(frames)), are_off, 0.5, 0.1, 0.4, 0.01, 500)


def must_not_be_called(*given):
    raise AssertionError("poses were adjusted again")


def run(out, revise="poses", overwrite=False):
    options = {"size": SIZE, "stride": 1, "max_views": None, "save_every": 8, "overwrite": overwrite, "revise": revise}
    return run_capture(
        StreamSplat(preset("tiny")), load_params("tiny"), CAPTURE, out, **options, reporter=Reporter(quiet=True)
    )


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Folder of a finished run of four small frames whose poses were moved."""
    out = tmp_path_factory.mktemp("adjusted")
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(adjusting, "adjust_poses", moved)
        run(out)
    return out


def test_the_stream_and_all_that_follows_see_the_adjusted_poses(finished, monkeypatch):
    monkeypatch.setattr(adjusting, "adjust_poses", must_not_be_called)
    given = open_capture(CAPTURE, size=SIZE)
    wanted = moved(given, range(4)).capture.camtoworlds
    assert run(finished).was_finished
    assert has_adjusted_poses(RunFolder(finished))
    cameras = open_cameras(CAPTURE, finished, finished / "scene.sog", Reporter(quiet=True))
    np.testing.assert_array_equal(cameras.capture.camtoworlds, wanted)
    result = refine_run(
        finished,
        CAPTURE,
        load_params("tiny"),
        steps=1,
        save_every=1,
        overwrite=True,
        reporter=Reporter(quiet=True),
    )
    assert result.num_steps == 1


def test_a_run_without_them_is_another_run(finished):
    with pytest.raises(InputError, match="differs in its poses"):
        run(finished, revise=None)


def test_a_finished_run_with_given_poses_takes_no_adjusted_ones_and_stays_usable(tmp_path, monkeypatch):
    folder, capture = RunFolder(tmp_path), open_capture(CAPTURE, size=SIZE)
    monkeypatch.setattr(adjusting, "adjust_poses", must_not_be_called)
    folder.state.write_bytes(b"of a run that began without")
    for revise in ("poses", "auto"):
        with pytest.raises(InputError, match=f"--revise {revise}: wanted a run that began with it"):
            capture_to_stream(capture, range(4), revise, folder, Reporter(quiet=True))
    assert not folder.adjusted_poses.exists()
    assert capture_to_stream(capture, range(4), None, folder, Reporter(quiet=True)) is capture


def test_poses_that_fitted_are_no_adjusted_ones(tmp_path, monkeypatch):
    folder, capture = RunFolder(tmp_path), open_capture(CAPTURE, size=SIZE)
    monkeypatch.setattr(adjusting, "adjust_poses", lambda *given: moved(*given, are_off=False))
    capture_to_stream(capture, range(4), "auto", folder, Reporter(quiet=True))
    folder.state.write_bytes(b"of the run")
    with pytest.raises(InputError, match="--revise poses: wanted a run that began with it"):
        capture_to_stream(capture, range(4), "poses", folder, Reporter(quiet=True))


def test_a_run_whose_poses_could_not_be_adjusted_goes_on(tmp_path, monkeypatch):
    folder, capture = RunFolder(tmp_path), open_capture(CAPTURE, size=SIZE)
    monkeypatch.setattr(adjusting, "adjust_poses", lambda *given: dataclasses.replace(moved(*given), num_points=0))
    for state in (None, b"of the run"):
        if state:
            folder.state.write_bytes(state)
        assert capture_to_stream(capture, range(4), "poses", folder, Reporter(quiet=True)).frames == capture.frames
        assert not has_adjusted_poses(folder)


@pytest.mark.parametrize(
    "earlier, indices", [(CAPTURE, (0, 2)), ("procedural:corridor?frames=4", range(4))], ids=["frames", "capture"]
)
def test_poses_that_a_stopped_run_left_for_another_stream_are_found_anew(earlier, indices, tmp_path, monkeypatch):
    folder, quiet = RunFolder(tmp_path), Reporter(quiet=True)
    monkeypatch.setattr(adjusting, "adjust_poses", moved)
    capture_to_stream(open_capture(earlier, size=SIZE), indices, "poses", folder, quiet)
    given = open_capture(CAPTURE, size=SIZE)
    streamed = capture_to_stream(given, range(4), "poses", folder, quiet)
    np.testing.assert_array_equal(streamed.camtoworlds, moved(given, range(4)).capture.camtoworlds)
    assert capture_to_stream(given, range(4), None, folder, quiet) is given
    assert not folder.adjusted_poses.exists()  # no later command takes them for those of the run


def test_pictures_and_cameras_of_a_run_have_its_adjusted_poses(finished, tmp_path, monkeypatch):
    given = open_capture(CAPTURE, size=SIZE)
    wanted = moved(given, range(4)).capture.camtoworlds
    path = f"{CAPTURE}&size={SIZE[0]}x{SIZE[1]}"
    cameras = open_cameras(path, finished / "scene.ply", tmp_path / "scene.ply", Reporter(quiet=True))
    np.testing.assert_array_equal(cameras.capture.camtoworlds, wanted)
    drawn = []

    def draw(splats, camtoworld, K, **given):
        drawn.append(camtoworld)
        return np.zeros((SIZE[1], SIZE[0], 3)), np.zeros((SIZE[1], SIZE[0]))

    monkeypatch.setattr(render_scene, "_render_picture", draw)
    for scene in (finished, finished / "scene.ply"):
        options = {"size": SIZE, "stride": 1, "max_views": None, "over_black": False, "film": None}
        render_scene.render_scene(scene, CAPTURE, tmp_path / "out", **options, reporter=Reporter(quiet=True))
    np.testing.assert_array_equal(drawn, [*wanted, *wanted])


@pytest.mark.parametrize("other", ["procedural:corridor?frames=4", "procedural:room?frames=3"])
def test_pictures_of_another_capture_have_its_poses_and_a_warning_says_so(other, finished, capsys):
    capture = open_capture_of_scene(finished, other, SIZE, Reporter(quiet=True))
    np.testing.assert_array_equal(capture.camtoworlds, open_capture(other, size=SIZE).camtoworlds)
    assert "adjusted_poses.json is of another capture" in capsys.readouterr().err


def test_poses_that_a_stopped_run_adjusted_anyway_are_judged_for_auto(tmp_path, monkeypatch):
    folder, capture, quiet = RunFolder(tmp_path), open_capture(CAPTURE, size=SIZE), Reporter(quiet=True)
    monkeypatch.setattr(adjusting, "adjust_poses", lambda *given: moved(*given, are_off=False))
    capture_to_stream(capture, range(4), "poses", folder, quiet)
    assert has_adjusted_poses(folder)
    streamed = capture_to_stream(capture, range(4), "auto", folder, quiet)
    np.testing.assert_array_equal(streamed.camtoworlds, capture.camtoworlds)
    assert not has_adjusted_poses(folder)


def test_poses_without_a_run_are_removed_even_if_they_are_damaged(tmp_path):
    folder, capture = RunFolder(tmp_path), open_capture(CAPTURE, size=SIZE)
    folder.adjusted_poses.write_text("{")
    folder.state.write_bytes(b"of the run")
    assert capture_to_stream(capture, range(4), None, folder, Reporter(quiet=True)) is capture
    assert folder.adjusted_poses.exists()  # what belongs to a run stays
    folder.state.unlink()
    assert capture_to_stream(capture, range(4), None, folder, Reporter(quiet=True)) is capture
    assert not folder.adjusted_poses.exists()


def test_poses_that_fit_are_kept_and_not_judged_twice(tmp_path, monkeypatch):
    capture, quiet = open_capture(CAPTURE, size=SIZE), Reporter(quiet=True)
    fits = lambda *given: moved(*given, are_off=False)  # noqa: E731
    monkeypatch.setattr(adjusting, "adjust_poses", fits)
    first = capture_to_stream(capture, range(4), "auto", RunFolder(tmp_path), quiet)
    monkeypatch.setattr(adjusting, "adjust_poses", must_not_be_called)
    second = capture_to_stream(capture, range(4), "auto", RunFolder(tmp_path), quiet)
    assert not has_adjusted_poses(RunFolder(tmp_path))
    for kept in (first, second):
        np.testing.assert_array_equal(kept.camtoworlds, capture.camtoworlds)


def test_saved_poses_of_another_capture_are_not_used(finished):
    other = open_capture("procedural:room?frames=4&seed=5", size=SIZE)
    other = moved(other, [2]).capture
    assert with_poses_of_run(other, RunFolder(finished)) is other


NOT_FINITE = json.dumps({"capture": "x", "indices": [0], "camtoworlds": {"0": np.full((4, 4), np.nan).tolist()}})


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"capture": "x", "indices": [0], "camtoworlds": {"0": [1, 2]}}', NOT_FINITE]
)
def test_damaged_poses_are_named(tmp_path, text):
    folder = RunFolder(tmp_path)
    folder.adjusted_poses.write_text(text)
    with pytest.raises(StorageError, match=r"adjusted_poses\.json: damaged; --overwrite"):
        with_poses_of_run(open_capture(CAPTURE, size=SIZE), folder)
    folder.clear_run()
    assert not folder.adjusted_poses.exists()
