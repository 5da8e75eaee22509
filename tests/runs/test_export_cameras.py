"""`ssplat export --cameras`: a COLMAP model beside the scene whose cameras see the scene as the capture's do."""

import dataclasses
import json
import shutil

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import ssplat_jax as ss
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.runs.export_cameras import SceneCameras, save_cameras
from ssplat_jax.scene_files.formats import save_ply
from tests.commands.test_cli import make_capture, run
from tests.scene_files.scene_fixture import scene


def turned_capture(folder):
    """A capture whose cameras are turned about every axis; the last one has another focal length."""
    capture = make_capture(folder, num_frames=4)
    facts = json.loads((capture / "transforms.json").read_text())
    for i, frame in enumerate(facts["frames"]):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_rotvec([0.3 * i, -0.5, 2.0 + 0.2 * i]).as_matrix()
        pose[:3, 3] = [0.1 * i, -3.0, 7.5]
        frame["transform_matrix"] = pose.tolist()
    (capture / "transforms.json").write_text(json.dumps(facts))
    return capture


def opened_model(folder, capture):
    """The written model, opened with the images of the capture."""
    (folder / "sparse").mkdir()
    for name in ("cameras.txt", "images.txt", "points3D.txt"):
        shutil.copy(folder / name, folder / "sparse" / name)
    for frame in ss.open_capture(capture).frames:
        (folder / frame.name).parent.mkdir(exist_ok=True)
        shutil.copy(frame.path, folder / frame.name)
    return ss.open_capture(folder)


@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), (4096.0, -8.0, 1.0)])
def test_the_model_opens_as_the_capture_it_was_written_from(tmp_path, offset):
    capture = turned_capture(tmp_path / "capture")
    save_ply(tmp_path / "scene.ply", scene(0), offset=offset)
    to = tmp_path / "model" / "scene.spz"
    assert run("export", str(tmp_path / "scene.ply"), "--to", str(to), "--cameras", str(capture)) == 0
    found, wanted = opened_model(tmp_path / "model", capture), ss.open_capture(capture)
    assert found.format == "COLMAP" and len(found) == len(wanted) == 4
    assert (found.width, found.height) == (wanted.width, wanted.height)
    moved = np.array(wanted.camtoworlds)
    moved[:, :3, 3] -= offset
    np.testing.assert_allclose(found.camtoworlds, moved, atol=1e-9)
    for i in range(4):
        np.testing.assert_allclose(found.K(i), wanted.K(i), rtol=1e-12)
        np.testing.assert_array_equal(found.image(i), wanted.image(i))


def test_a_line_of_images_txt_takes_points_to_pixels(tmp_path):
    capture = turned_capture(tmp_path / "capture")
    save_ply(tmp_path / "scene.ply", scene(0))
    assert run("export", str(tmp_path / "scene.ply"), "--to", str(tmp_path / "a.ply"), "--cameras", str(capture)) == 0
    images = [line for line in (tmp_path / "images.txt").read_text().splitlines() if not line.startswith("#")]
    assert len(images) == 8 and images[1::2] == [""] * 4
    number, qw, qx, qy, qz, *translation, camera, name = images[4].split()
    assert (number, name) == ("3", "images/2.png")
    opened = ss.open_capture(capture)
    point = opened.frames[2].camtoworld @ [0.2, -0.1, 3.0, 1.0]  # in front of the third camera
    rotation = Rotation.from_quat([float(x) for x in (qx, qy, qz, qw)])
    np.testing.assert_allclose(rotation.apply(point[:3]) + np.array(translation, float), [0.2, -0.1, 3.0], atol=1e-9)
    cameras = [line.split() for line in (tmp_path / "cameras.txt").read_text().splitlines() if line[0] != "#"]
    (held,) = [line for line in cameras if line[0] == camera]
    assert held[1:4] == ["PINHOLE", "32", "24"] and [float(x) for x in held[4:]] == [32.0, 32.0, 16.0, 12.0]


def test_a_runs_own_frames_are_written_and_other_captures_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("ssplat_jax.streaming.session.MIN_DECODED_PIVOTS", 1 << 11)
    capture, out = make_capture(tmp_path / "capture", num_frames=8), tmp_path / "run"
    assert run("run", str(capture), "--stride", "2", "--out", str(out), "--quiet") == 0
    to = tmp_path / "export" / "scene.ply"
    assert run("export", str(out), "--to", str(to), "--cameras", str(capture)) == 0
    lines = (tmp_path / "export" / "images.txt").read_text().splitlines()
    assert [line.split()[-1] for line in lines if line and line[0] != "#"] == [f"images/{i}.png" for i in (0, 2, 4, 6)]
    other, to = turned_capture(tmp_path / "other"), tmp_path / "none" / "scene.ply"
    assert run("export", str(out), "--to", str(to), "--cameras", str(other)) == 2
    assert "wanted the capture of the run" in capsys.readouterr().err and not to.parent.exists()


def test_a_model_of_another_maker_is_not_overwritten(tmp_path, capsys):
    capture = turned_capture(tmp_path / "capture")
    ply, to = tmp_path / "scene.ply", tmp_path / "scene.spz"
    save_ply(ply, scene(0))
    (tmp_path / "images.txt").write_text("# Image list with two lines of data per image\n")
    assert run("export", str(ply), "--to", str(to), "--cameras", str(capture)) == 2
    assert "in the way" in capsys.readouterr().err and not to.exists()
    assert not (tmp_path / "cameras.txt").exists()
    (tmp_path / "images.txt").unlink()
    for _ in range(2):  # its own files are written again
        assert run("export", str(ply), "--to", str(to), "--cameras", str(capture)) == 0


def test_missing_captures_are_refused_before_anything_is_written(tmp_path, capsys):
    nothing = Gaussians.from_rgb(
        means=jnp.zeros((0, 3)),
        quats=jnp.zeros((0, 4)),
        scales=jnp.zeros((0, 3)),
        opacities=jnp.zeros(0),
        colors=jnp.zeros((0, 3)),
    )
    save_ply(tmp_path / "scene.ply", nothing)
    to = tmp_path / "to" / "scene.ply"
    assert run("export", str(tmp_path / "scene.ply"), "--to", str(to), "--cameras", str(tmp_path / "no")) == 2
    assert capsys.readouterr().err.count("\n") == 1 and not to.parent.exists()


def test_names_that_are_not_utf8_are_written_as_their_bytes(tmp_path):
    """Names on Linux are bytes; Python keeps the others as surrogates."""
    opened = ss.open_capture("procedural:room?frames=2")
    frames = [dataclasses.replace(frame, name=f"caf\udce9{i}.jpg") for i, frame in enumerate(opened.frames)]
    cameras = SceneCameras(dataclasses.replace(opened, frames=tuple(frames)), [0, 1])
    save_cameras(tmp_path, cameras, (0.0, 0.0, 0.0))
    assert b" caf\xe91.jpg\n" in (tmp_path / "images.txt").read_bytes()
