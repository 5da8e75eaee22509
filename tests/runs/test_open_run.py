"""A run folder: damaged states, what identifies a run, and poses that are adjusted once, then used everywhere."""

import contextlib
from types import SimpleNamespace
from unittest.mock import Mock

import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.config import preset
from ssplat_jax.core.atomic import previous_path
from ssplat_jax.core.console import Reporter
from ssplat_jax.core.errors import InputError, StorageError
from ssplat_jax.core.pytree import replace
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.poses import adjust_poses as adjusting
from ssplat_jax.runs import capture_run, open_run
from ssplat_jax.runs.stream_commands import Run
from ssplat_jax.storage.chunk_records import load_chunk_records, save_chunk_record
from ssplat_jax.storage.run_folder import RunFolder
from ssplat_jax.storage.weights import load_params
from tests.data.capture_fixture import with_poses
from tests.runs.test_run_results import record

CAPTURE, SIZE = "procedural:room?frames=8", (64, 48)
QUIET = Reporter(quiet=True)
CONFIG = preset("tiny").replace(capacity=256)
SHIFT = np.array([0.01, 0.0, 0.02])


@pytest.fixture(scope="module")
def capture():
    return open_capture(CAPTURE, size=SIZE)


def opened(capture, out, reporter=QUIET, **options):
    model = StreamSplat(CONFIG)
    return open_run.open_run(model, load_params("tiny"), capture, range(8), out, reporter=reporter, **options)


def save_views(run, count):
    """Saves the run as after `count` views, which fill as many voxels."""
    cache = run.session.model.init_cache()
    run.session.cache = replace(cache, num_voxels=jnp.int32(count), voxels=cache.voxels.at[:count].set(count))
    run.exposures = {i: np.full(3, 0.5, np.float32) for i in range(count)}
    run.images = {str(i): run.capture.files_digest(i) for i in range(count)}
    run.save()


def test_a_damaged_state_is_kept_aside_and_the_one_before_takes_its_place(capture, tmp_path, capsys):
    with opened(capture, tmp_path) as run:
        assert run.num_views == 0
        for count in (4, 8):
            save_views(run, count)
    folder = RunFolder(tmp_path)
    good, damaged = previous_path(folder.state).read_bytes(), folder.state.read_bytes()[:-7]
    folder.state.write_bytes(damaged)
    assert open_run.load_run(tmp_path, QUIET).header["done"] == 4
    capsys.readouterr()
    with opened(capture, tmp_path, Reporter()) as run:
        assert "after 4 views" in " ".join(capsys.readouterr().err.split())
        assert run.num_views == run.num_saved == 4 and int(run.session.cache.num_voxels) == 4
    aside = folder.state.with_name(folder.state.name + ".damaged")
    held = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert held == {folder.state.name: good, aside.name: damaged}


def test_saves_take_at_most_a_tenth_of_the_time(capture, tmp_path, monkeypatch):
    times = iter([100.0, 200.0, 200.5, 300.0, 308.0])  # of the opening, and around two saves
    monkeypatch.setattr(open_run, "time", SimpleNamespace(monotonic=lambda: next(times)))
    with opened(capture, tmp_path) as run:
        due = [run.next_save]
        for count in (4, 8, 8):  # the last is saved already
            save_views(run, count)
            due.append(run.next_save)
    assert due == [130.0, 230.5, 388.0, 388.0]


@pytest.mark.parametrize(
    ("next_save", "every", "saved"),
    [(-np.inf, None, [4, 8]), (np.inf, None, []), (np.inf, 1, [4, 8]), (-np.inf, 2, [8])],
)
def test_a_stream_is_saved_when_it_is_due_and_at_its_end(next_save, every, saved, tmp_path, monkeypatch):
    """Two chunks, known by the number of views after them, without a model; one save more comes at the end."""
    for name in ("DeltaWriter", "record_chunk"):
        monkeypatch.setattr(capture_run, name, Mock())
    run, done = SimpleNamespace(num_views=0, next_save=next_save), []
    run.take, run.save = lambda views: setattr(run, "num_views", views), lambda: done.append(run.num_views)
    source = SimpleNamespace(total=8, chunks=lambda *given: [4, 8])
    capture_run._stream.__wrapped__(run, source, Run(CAPTURE, tmp_path, save_every=every), QUIET)
    assert done == [*saved, 8]


def test_no_readable_state_suggests_overwrite(capture, tmp_path):
    folder = RunFolder(tmp_path)
    folder.state.write_bytes(b"PK damaged")
    previous_path(folder.state).write_bytes(b"damaged too")
    before = sorted(path.name for path in tmp_path.iterdir())
    with pytest.raises(StorageError, match=r"state\.npz.*--overwrite"), opened(capture, tmp_path):
        pass
    assert sorted(path.name for path in tmp_path.iterdir()) == before
    with opened(capture, tmp_path, overwrite=True):
        assert not any(tmp_path.iterdir())


def test_capacity_matters_only_if_tokens_may_be_dropped():
    def fields(**changes):
        return open_run.deciding(preset("tiny").replace(**changes).to_dict())

    assert fields(capacity=1024) == fields(capacity=4096)
    assert fields(overflow="drop_new", capacity=1024) != fields(overflow="drop_new", capacity=4096)


def moved(capture, indices, advance=None):
    """An adjustment that moves every frame by the same shift."""
    poses = capture.camtoworlds
    poses[list(indices), :3, 3] += SHIFT
    return adjusting.AdjustedPoses(with_poses(capture, poses), 0.5, 0.1, 0.4, 0.01, 500)


@contextlib.contextmanager
def adjustment(is_found=True):
    """Poses are adjusted by `moved`, or must not be."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(adjusting, "adjust_poses", moved if is_found else None)
        yield


@pytest.fixture
def adjusted(capture, tmp_path):
    """Folder of a run that has begun with adjusted poses."""
    with adjustment(), opened(capture, tmp_path / "run", adjust_poses=True) as run:
        save_views(run, 8)
    return tmp_path / "run"


def test_all_that_follows_sees_the_adjusted_poses(adjusted, capture, capsys):
    wanted = moved(capture, range(8)).capture.camtoworlds
    with adjustment(is_found=False), opened(capture, adjusted, adjust_poses=True) as run:
        np.testing.assert_array_equal(run.capture.camtoworlds, wanted)
    with pytest.raises(InputError, match="differs in its poses"), opened(capture, adjusted):
        pass
    path = f"{CAPTURE}&size={SIZE[0]}x{SIZE[1]}"
    np.testing.assert_array_equal(open_run.load_run(adjusted, QUIET).open_capture(CAPTURE).camtoworlds, wanted)
    for place in (adjusted, adjusted / "scene.ply"):
        np.testing.assert_array_equal(open_run.open_capture_of_scene(place, path, None, QUIET).camtoworlds, wanted)
    capsys.readouterr()
    other = "procedural:room?frames=3"  # it has its own poses
    found = open_run.open_capture_of_scene(adjusted, other, SIZE, QUIET)
    np.testing.assert_array_equal(found.camtoworlds, open_capture(other, size=SIZE).camtoworlds)
    assert "adjusted_poses.npz is of another capture" in capsys.readouterr().err
    with pytest.raises(InputError, match="wanted the capture of the run"):
        open_run.load_run(adjusted, QUIET).open_capture(other)


def test_a_new_run_leaves_nothing_that_could_pass_for_its_own(capture, tmp_path):
    """Killed after its last chunk, it would take the scene of another run of as many views for its own."""
    folder = RunFolder(tmp_path / "run")
    folder.path.mkdir()
    for left in (folder.metrics, folder.refined_scene):
        left.write_bytes(b"of a run whose state was removed")
    with opened(capture, folder.path):
        assert not folder.metrics.exists() and not folder.refined_scene.exists()


def test_files_of_others_are_neither_records_nor_deltas(tmp_path):
    folder = RunFolder(tmp_path)
    for k in (4, 8):
        save_chunk_record(folder.chunk_record(k), record(k))
    folder.deltas.mkdir()
    for name in ("notes.json", "._000004.json", "0000041.json"):  # of the user, or of another system
        (folder.chunk_records / name).write_text("{}")
        (folder.deltas / name).with_suffix(".npz").write_bytes(b"")
    assert not folder.delta_files()
    assert [r.num_views for r in load_chunk_records(folder.chunk_record_files())] == [4, 8]
    folder.chunk_record(8).write_text("[]")  # up to a damaged one
    assert [r.num_views for r in load_chunk_records(folder.chunk_record_files())] == [4]


def test_a_run_that_began_with_given_poses_takes_no_adjusted_ones(capture, tmp_path):
    folder = RunFolder(tmp_path)
    folder.state.write_bytes(b"of a run that began without")
    with adjustment(is_found=False), pytest.raises(InputError, match="--adjust-poses: wanted a run that began with it"):
        open_run.capture_to_stream(capture, range(4), folder, QUIET, adjust_poses=True)
    assert open_run.capture_to_stream(capture, range(4), folder, QUIET, adjust_poses=False) is capture


def test_poses_that_a_stopped_run_left_for_another_stream_are_found_anew(capture, tmp_path):
    folder = RunFolder(tmp_path)
    with adjustment():
        open_run.capture_to_stream(capture, (0, 2), folder, QUIET, adjust_poses=True)
        streamed = open_run.capture_to_stream(capture, range(4), folder, QUIET, adjust_poses=True)
    np.testing.assert_array_equal(streamed.camtoworlds, moved(capture, range(4)).capture.camtoworlds)
    assert open_run.capture_to_stream(capture, range(4), folder, QUIET, adjust_poses=False) is capture
    assert not folder.adjusted_poses.exists()  # no later command takes them for those of the run


def test_damaged_poses_are_named(capture, tmp_path):
    folder = RunFolder(tmp_path)
    folder.adjusted_poses.write_text("{")
    with pytest.raises(StorageError, match=r"adjusted_poses\.npz: the file is corrupt"):
        open_run.with_poses_of_run(capture, folder)
    folder.state.write_bytes(b"of the run")
    assert open_run.capture_to_stream(capture, range(4), folder, QUIET, adjust_poses=False) is capture
    assert folder.adjusted_poses.exists()  # what belongs to a run stays
    folder.clear_run()
    assert open_run.load_poses(folder) is None
