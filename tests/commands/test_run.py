"""`ssplat run`: stops and resumes to the same bytes, refuses what does not belong to it, and is exported as it is."""

import functools
import re
import shutil
from pathlib import Path

import jax
import numpy as np
import pytest
from jax import monitoring

from ssplat_jax.config import StreamConfig
from ssplat_jax.core.atomic import previous_path
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.storage.chunk_records import load_chunk_records, load_delta, open_thumbnail, save_chunk_record
from ssplat_jax.storage.run_folder import RunFolder
from ssplat_jax.storage.saved_states import load_state
from ssplat_jax.storage.weights import load_weights
from ssplat_jax.streaming.scene_delta import apply_delta
from tests.commands.command_fixture import SIZE, edit, make_capture, read, run
from tests.runs.test_run_results import record


@pytest.fixture(scope="module")
def finished(narrow, programs_shared, tmp_path_factory):
    """A capture of 12 frames and the folder of its run, saved after every chunk, with deltas."""
    folder = tmp_path_factory.mktemp("finished")
    capture, out = make_capture(folder / "capture", num_frames=12, size=SIZE), folder / "run"
    (out / "deltas").mkdir(parents=True)
    (out / "deltas" / "000003.npz").write_bytes(b"of a run that was stopped before its first save")
    assert run("run", capture, "--out", out, "--save-every", 1, "--deltas", *narrow) == 0
    return folder


@pytest.fixture
def copied(finished, tmp_path):
    """Capture and folder of a finished run, to be changed."""
    shutil.copytree(finished, tmp_path / "held")
    return tmp_path / "held" / "capture", tmp_path / "held" / "run"


def contents(folder):
    return {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in folder.rglob("*.*")}


def assert_deltas_give_the_scene(out, narrow, *names):
    """The changes of every chunk, put together, against the final state decoded at once."""
    files = sorted((out / "deltas").iterdir())
    assert [path.name for path in files] == list(names)
    told = functools.reduce(apply_delta, (load_delta(file)[0] for file in files), None)
    cache, header = load_state(out / "state.npz")
    exposure = np.exp(np.median(np.log(list(header["exposures"].values())), axis=0)).tolist()
    told_header = load_delta(files[-1])[1]
    assert told_header.pop("exposure") == pytest.approx(exposure)
    assert told_header == {"frame": header["frame"], "views": header["done"]}
    model, params = StreamSplat(StreamConfig.from_dict(header["config"])), load_weights(Path(narrow[1]))[0]
    scene = jax.jit(model.decode)(params, cache)
    assert 0 < (told.opacities > 0).sum() == (np.asarray(scene.opacities) > 0).sum()
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5), told, scene)


def test_a_run_writes_scene_state_metrics_and_the_changes_of_every_chunk(finished, narrow):
    out, metrics = finished / "run", read(finished / "run" / "metrics.json")
    assert {"scene.ply", "state.npz", "metrics.json", "report.html", "views"} <= {p.name for p in out.iterdir()}
    assert_deltas_give_the_scene(out, narrow, "000004.npz", "000008.npz", "000012.npz")
    assert metrics["cache"]["num_chunks"] == 3 and list(metrics["exposures"]) == [str(i) for i in range(12)]
    assert metrics["peak_memory_bytes"] >= metrics["step_memory_bytes"] > 0
    assert (out / "report.html").read_text().count("--weights WEIGHTS") == 2  # not the shipped ones


def test_an_export_is_the_scene_of_the_run(finished, narrow, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("ssplat_jax.runs.scene_outputs.difference_in_words", lambda *given: None)  # renders it
    out, weights = finished / "run", narrow[:2]
    assert run("export", out, "--to", tmp_path / "again.ply", *weights) == 0
    # Rows of padding, which fill the arrays up to a power of two, are no Gaussians that were left out.
    counts = [int(word) for word in re.findall(r"\d+", capsys.readouterr().out.split("again.ply")[1].splitlines()[0])]
    assert sum(counts) == read(out / "metrics.json")["cache"]["decoded"]
    assert (tmp_path / "again.ply").read_bytes() == (out / "scene.ply").read_bytes()
    assert run("export", out, "--to", tmp_path / "wrong.ply") == 2
    assert "other weights" in capsys.readouterr().err and not (tmp_path / "wrong.ply").exists()


def test_a_finished_run_is_not_streamed_twice(copied, narrow, capsys):
    capture, out = copied
    shutil.rmtree(out / "deltas")  # asked for only now, they begin with the whole scene
    assert run("run", capture, "--out", out, "--deltas", *narrow) == 0
    assert_deltas_give_the_scene(out, narrow, "000012.npz")
    before = contents(out)
    with pytest.MonkeyPatch.context() as patch:  # nothing of it is computed or written again
        patch.setattr("ssplat_jax.runs.capture_run.finish_run", None)
        patch.setattr("ssplat_jax.streaming.session.Session.gaussians", None)
        capsys.readouterr()
        assert run("run", capture, "--out", out, *narrow) == 0
    assert capsys.readouterr().out.startswith(f"{out} holds this run, finished: scene.ply (")
    assert contents(out) == before
    (out / "metrics.json").unlink()  # stopped while it wrote its results, it writes them when it goes on
    assert run("run", capture, "--out", out, *narrow) == 0
    assert capsys.readouterr().out.startswith("wrote ") and (out / "metrics.json").exists()


def test_a_stopped_run_continues_to_the_same_bytes(copied, finished, narrow):
    capture, out = copied
    folder = RunFolder(out)
    shutil.copy(previous_path(folder.state), folder.state)
    save_chunk_record(folder.chunk_record(40), record(40))  # of a process that was killed after its last save
    folder.delta(40).touch()
    assert run("run", capture, "--out", out, *narrow) == 0
    for name in ("scene.ply", "state.npz"):
        assert (out / name).read_bytes() == (finished / "run" / name).read_bytes()
    assert [path.stem for path in folder.chunk_record_files()] == ["000004", "000008", "000012"]
    assert not folder.delta_files()  # without those of the last chunk, they would not add up to the scene


def test_another_run_is_refused(copied, narrow, tmp_path, capsys):
    capture, out = copied
    for changes, difference in (
        (("--set", "voxel_size=0.1"), "differs in its config.memory.voxel_size (0.04 there, 0.1 now)"),
        (("--stride", "2"), "there, [0, 2, 4, 6, 8, 10] now)"),
        (("--quality", "fast"), "differs in its size[0] (64 there, 32 now)"),
    ):
        assert run("run", capture, "--out", out, *changes, *narrow) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert difference in line and "--overwrite" in line
    images = capture / "images"
    kept = (images / "5.png").read_bytes()
    (images / "5.png").write_bytes((images / "4.png").read_bytes())
    assert run("run", capture, "--out", out, *narrow) == 2
    assert "differs in its images.5 (" in capsys.readouterr().err
    (images / "5.png").write_bytes(kept)
    edit("transform_matrix", np.eye(4).tolist())(capture)  # a corrected pose
    assert run("run", capture, "--out", out, *narrow) == 2
    assert "differs in its poses" in capsys.readouterr().err


def test_a_damaged_image_stops_the_stream_with_what_came_before_it_saved(finished, narrow, tmp_path, capsys):
    capture, out = tmp_path / "capture", tmp_path / "out"
    shutil.copytree(finished / "capture", capture)
    image = capture / "images" / "9.png"
    whole = image.read_bytes()
    image.write_bytes(whole[:200])
    # The estimate of depths decodes a few images, and would find it before the stream.
    with pytest.MonkeyPatch.context() as patch:
        frame = open_capture(finished / "capture").stream_frame(load_weights(Path(narrow[1]))[1])
        patch.setattr("ssplat_jax.data.capture.Capture.stream_frame", lambda *given: frame)
        assert run("run", capture, "--out", out, "--causal", *narrow) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "9.png" in line and "8 views are saved; mend it" in line
    assert load_state(out / "state.npz")[1]["done"] == 8 and not (out / "scene.ply").exists()
    image.write_bytes(whole)
    assert run("run", capture, "--out", out, "--causal", *narrow) == 0
    assert read(out / "metrics.json")["views"] == 12


def test_a_run_records_its_chunks(finished):
    capture, folder = open_capture(finished / "capture"), RunFolder(finished / "run")
    records = load_chunk_records(folder.chunk_record_files())
    assert [r.num_views for r in records] == [4, 8, 12]
    views = [view for r in records for view in r.views]
    assert sorted(view.frame for view in views) == list(range(12))
    metrics = read(folder.metrics)
    for view in views:
        np.testing.assert_array_equal(view.camtoworld, capture.frames[view.frame].camtoworld)
        np.testing.assert_array_equal(view.K, capture.K(view.frame))
        np.testing.assert_allclose(view.exposure, metrics["exposures"][str(view.frame)])
        assert np.abs(open_thumbnail(view.thumbnail) / 255 - capture.image(view.frame)).mean() < 0.1  # JPEG of noise
    assert records[-1].num_gaussians == metrics["cache"]["decoded"]
    assert 0 < records[0].occupancy <= records[-1].occupancy <= 1 and all(r.seconds > 0 for r in records)


def test_a_run_compiles_few_programs(finished, narrow, tmp_path):
    """Host code computes with NumPy: each operation of JAX outside jit is a program of its own.

    Step and decoding are those of the runs before it.
    """
    compiled = []

    def heard(event, seconds, **facts):
        if event.endswith("backend_compile_duration"):
            compiled.append(seconds)

    jax.clear_caches()
    monitoring.register_event_duration_secs_listener(heard)
    try:
        assert run("run", finished / "capture", "--out", tmp_path / "out", *narrow) == 0
    finally:
        monitoring.unregister_event_duration_listener(heard)
    assert 3 < len(compiled) <= 6


@pytest.mark.slow
def test_run_refine_equals_run_then_refine(tmp_path, capsys):
    capture, size = "procedural:room?frames=4", ("--size", "64x48")
    one, two = (tmp_path / name for name in ("one", "two"))
    assert run("run", capture, "--out", one, *size, "--refine", "2", "--quiet") == 0
    assert "refined.ply: 2 steps" in capsys.readouterr().out
    assert run("run", capture, "--out", two, *size, "--quiet") == 0
    assert run("refine", two, capture, "--steps", "2", "--quiet") == 0
    for name in ("scene.ply", "refined.ply"):
        assert (one / name).read_bytes() == (two / name).read_bytes()
