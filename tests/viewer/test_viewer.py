"""Scenes and pictures that browsers are sent, their sources, and the server."""

import contextlib
import functools
import json
import sys
import urllib.request

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import ssplat_jax as ss
from ssplat_jax.core.errors import InputError, StorageError
from ssplat_jax.core.gaussians import SH_C0
from ssplat_jax.core.pytree import replace
from ssplat_jax.storage.chunk_records import ChunkRecord, RecordedView, load_delta, save_chunk_record, save_delta
from ssplat_jax.storage.run_folder import RunFolder
from ssplat_jax.streaming.scene_delta import apply_delta
from ssplat_jax.viewer.stage import MAX_SIGMA, GrowingScene, SceneFile, Stage, median_size, open_source, visible_splats
from ssplat_jax.viewer.view_scene import Viewer, import_viser
from tests.scene_files.scene_fixture import scene
from tests.viewer.fake_client import delta, frame, free_port, header

HALF_PRECISION = 2.0**-11  # relative rounding of a 16-bit float


@pytest.mark.parametrize("size", [1e-4, 1.0, 1e4])
def test_splats_equal_the_gaussians_in_16_bits_at_any_size(size):
    gaussians = scene(0)
    gaussians = replace(gaussians, means=size * gaussians.means, scales=size * gaussians.scales)
    unit = median_size(gaussians)
    splats = visible_splats(gaussians, unit, max_gaussians=1000)
    rotations = Rotation.from_quat(np.asarray(gaussians.quats)[:, [1, 2, 3, 0]]).as_matrix()
    wanted = np.einsum("nij,nj,nkj->nik", rotations, np.asarray(gaussians.scales, np.float64) ** 2, rotations)
    largest = np.abs(wanted).max(axis=(1, 2), keepdims=True)
    sent = splats["covariances"].astype(np.float16).astype(np.float64) * unit**2
    np.testing.assert_allclose(sent / largest, wanted / largest, atol=2 * HALF_PRECISION)
    np.testing.assert_allclose(splats["centers"] * unit, gaussians.means, rtol=1e-5, atol=1e-6 * size)
    np.testing.assert_allclose(splats["rgbs"], np.clip(0.5 + SH_C0 * gaussians.sh[:, 0], 0, 1), atol=1e-6)
    np.testing.assert_array_equal(splats["opacities"][:, 0], gaussians.opacities)


def test_invisible_gaussians_are_dropped_and_huge_ones_cut():
    gaussians = scene(0)
    means = gaussians.means.at[0, 0].set(np.nan)
    scales = gaussians.scales.at[1].set(np.inf).at[2].set(1e6)
    opacities = gaussians.opacities.at[3].set(0.0).at[4].set(1 / 256)
    spoiled = replace(gaussians, means=means, scales=scales, opacities=opacities)
    splats = visible_splats(spoiled, 0.1, max_gaussians=1000)
    assert len(splats["centers"]) == 60 - 4
    assert all(np.isfinite(x).all() for x in splats.values())
    assert np.isfinite(splats["covariances"].astype(np.float16)).all()
    np.testing.assert_allclose(np.linalg.eigvalsh(splats["covariances"][0]), MAX_SIGMA**2, rtol=1e-5)


def test_too_many_gaussians_are_evenly_subsampled():
    every, some = (visible_splats(scene(0), 1.0, max_gaussians=most) for most in (60, 17))
    places = [int(np.flatnonzero((every["centers"] == center).all(axis=1))[0]) for center in some["centers"]]
    assert len(places) == 17 and places[0] == 0 and places[-1] == 59
    assert set(np.diff(places)) == {3, 4}
    growth = some["covariances"] / every["covariances"][places]
    np.testing.assert_allclose(growth, 60 / 17, rtol=1e-5)  # as many times the area as there are times fewer
    nothing = replace(scene(0), opacities=jnp.zeros(60))
    assert median_size(nothing) == 1.0 and len(visible_splats(nothing, 1.0, max_gaussians=10)["centers"]) == 0


def test_a_growing_run_is_what_its_deltas_add_up_to(tmp_path):
    origin = (5e6, 0.0, 1.0)  # so far that positions are counted from an offset
    stream, source = header(frame(origin)), GrowingScene(RunFolder(tmp_path))
    assert source.changed() is None and source.stream_frame() is None
    deltas = [delta([0, 1], 1), delta([1, 2, 5], 2), delta([0], 3)]
    save_delta(tmp_path / "deltas" / "000004.npz", deltas[0], stream)
    assert source.changed() is not None and source.changed() is None
    for number, more in enumerate(deltas[1:], start=2):
        save_delta(tmp_path / "deltas" / f"{4 * number:06d}.npz", more, stream)
    found = source.changed()
    known = jax.tree.map(jnp.asarray, functools.reduce(apply_delta, deltas, None))
    wanted = frame(origin).gaussians_to_capture(known)
    for name in ("means", "quats", "scales", "opacities", "sh"):
        np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name))
    # Started anew: what the old run had is forgotten.
    for path in (tmp_path / "deltas").iterdir():
        path.unlink()
    save_delta(tmp_path / "deltas" / "000004.npz", deltas[1], stream)
    anew = source.changed()
    np.testing.assert_array_equal(np.asarray(anew.opacities) > 0, np.repeat([0, 1, 1, 0, 0, 1, 0, 0], 2) > 0)


def test_a_run_that_has_been_refined_shows_its_refined_scene(tmp_path):
    source = GrowingScene(RunFolder(tmp_path))
    save_delta(tmp_path / "deltas" / "000004.npz", delta([0, 1], 1), header())
    assert len(source.changed().means) != len(scene(0).means)
    for _ in range(2):  # written, and written anew
        ss.save_ply(tmp_path / "refined.ply", scene(0))
        assert len(source.changed().means) == len(scene(0).means) and source.changed() is None
        (tmp_path / "refined.ply").unlink()
        assert source.changed() is None


def test_a_growing_run_is_shown_at_its_middle_exposure(tmp_path):
    source, parts = GrowingScene(RunFolder(tmp_path)), ((delta([0, 1], 1), [1, 1, 1]), (delta([2], 2), [3.0, 2.0, 0.5]))
    colors = []
    for number, (part, exposure) in enumerate(parts, start=1):
        save_delta(tmp_path / "deltas" / f"{4 * number:06d}.npz", part, header(exposure=exposure))
        colors.append(0.5 + SH_C0 * np.asarray(source.changed().sh[:4, 0], np.float64))
    np.testing.assert_allclose(colors[1], colors[0] * [3.0, 2.0, 0.5], atol=1e-6)


def test_a_run_that_starts_anew_while_it_is_read_is_read_again(tmp_path, monkeypatch):
    source = GrowingScene(RunFolder(tmp_path))
    for number in (1, 2):
        save_delta(tmp_path / "deltas" / f"{4 * number:06d}.npz", delta([0, 1], number), header())

    def vanish(path):
        if path.name == "000008.npz":
            path.unlink()
        return load_delta(path)

    monkeypatch.setattr("ssplat_jax.viewer.stage.load_delta", vanish)
    assert source.changed() is None
    np.testing.assert_array_equal(source.changed().opacities[:4], delta([0, 1], 1).gaussians.opacities)
    (tmp_path / "deltas" / "000012.npz").write_bytes(b"damaged")
    with pytest.raises(StorageError, match=r"000012\.npz"):
        source.changed()


def test_a_scene_file_is_read_again_when_it_is_written_again(tmp_path):
    file = tmp_path / "scene.ply"
    ss.save_ply(file, scene(0, 5))
    source = open_source(tmp_path)
    assert isinstance(source, SceneFile)
    assert source.changed().num_gaussians == 5 and source.changed() is None
    ss.save_ply(file, scene(0, 7))
    assert source.changed().num_gaussians == 7
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])  # by a program that is still writing
    assert source.changed() is None
    ss.save_ply(file, scene(0, 6))
    assert source.changed().num_gaussians == 6
    file.unlink()
    assert source.changed() is None  # shown on


def test_a_scene_stays_until_the_next_metrics_are_there(tmp_path):
    """A run that ends again removes its metrics, writes its scene, and then writes its metrics."""
    file, metrics = tmp_path / "scene.ply", tmp_path / "metrics.json"
    ss.save_ply(file, scene(0, 5))
    metrics.write_text("{}")
    source = open_source(tmp_path)
    assert source.changed() is not None
    metrics.unlink()
    assert source.changed() is None
    ss.save_ply(file, scene(0, 7))
    assert source.changed() is None
    metrics.write_text("{}")
    assert source.changed().num_gaussians == 7


def opened(path, max_gaussians=1000):
    stage = Stage(open_source(path), max_gaussians=max_gaussians)
    stage.refresh()
    return stage


def test_viewing_starts_where_the_scene_is_seen(tmp_path):
    """Before a lone file; at a run's first camera, or in the middle of its path; other files do not matter."""
    ss.save_ply(tmp_path / "scene.ply", scene(0, 5))
    metrics, far, folder = tmp_path / "metrics.json", frame((1e6, 2.0, 3.0)), RunFolder(tmp_path)
    assert far.offset[0] > 1e5
    for other in ("", "[]", '{"stream_frame": {"rotation": 1}}', "\x00"):
        metrics.write_text(other)
        np.testing.assert_array_equal(opened(tmp_path).start[:3, :3], np.eye(3))
    metrics.write_text(json.dumps({"stream_frame": far.to_dict()}))
    stage = opened(tmp_path)
    np.testing.assert_allclose(stage.start[:3], np.c_[far.rotation, far.origin - far.offset])
    assert stage.distance == pytest.approx(1.0)  # the middle depth of 0.5 to 8 stream units is 2 of them
    rng = np.random.default_rng(0)
    poses = {number: np.eye(4) for number in (4, 0, 3, 1, 2)}  # in the order of streaming
    for number, pose in poses.items():
        pose[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        pose[:3, 3] = [1e6 + number, 5.0, 6.0]
    views = [RecordedView(number, pose, np.eye(3), np.ones(3), b"") for number, pose in poses.items()]
    save_chunk_record(folder.chunk_record(5), ChunkRecord(5, (32, 24), tuple(views), 0.1, 0.5, 5))
    wanted = poses[2] - np.pad(np.array(far.offset)[:, None], ((0, 1), (3, 0)))
    np.testing.assert_allclose(opened(tmp_path).start, wanted)


def test_viser_and_an_address_that_cannot_be_used_are_refused_at_once(monkeypatch):
    for host, port in (("192.0.2.7", 8080), ("nosuch.invalid", 8080), ("127.0.0.1", 70000), ("127.0.0.1", 0)):
        with pytest.raises(InputError, match=rf"view: cannot listen on {host}:{port} \(.*\); choose another"):
            import_viser(host, port)
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(InputError, match=r'pip install -e "\.\[viewer\]"'):
        import_viser("127.0.0.1", 8080)


def test_the_server_answers_at_its_url_and_prints_nothing(tmp_path, capsys):
    pytest.importorskip("viser")
    ss.save_ply(tmp_path / "scene.ply", scene(0))
    with contextlib.closing(Viewer(opened(tmp_path), host="127.0.0.1", port=free_port())) as viewer:
        assert viewer.url.startswith("http://localhost:")
        with urllib.request.urlopen(viewer.url, timeout=20) as page:
            assert page.status == 200
        viewer.update()
        assert not viewer.browsers
    assert capsys.readouterr() == ("", "")
