"""The viewer: what a browser is sent, where it comes from, and, with viser and Chromium, what the browser shows."""

import json
import signal
import socket
import subprocess
import sys
import urllib.request

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import ssplat_jax as ss
from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.errors import InputError, StorageError
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.core.pytree import replace
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.scene_files.formats import save_gaussians
from ssplat_jax.storage.chunk_records import ChunkRecord, RecordedView, load_delta, save_chunk_record, save_delta
from ssplat_jax.storage.run_folder import RunFolder
from ssplat_jax.streaming.scene_delta import SceneDelta, apply_delta
from ssplat_jax.viewer.scene_sources import GrowingScene, SceneFile, open_source
from ssplat_jax.viewer.splats import MAX_SIGMA, median_size, visible_splats
from ssplat_jax.viewer.stage import Stage
from ssplat_jax.viewer.start_camera import camera_before, first_camera
from ssplat_jax.viewer.viser_viewer import Viewer

HALF_PRECISION = 2.0**-11  # relative rounding of a 16-bit float


def scene(num_gaussians=50, size=1.0):
    rng = np.random.default_rng(0)
    values = {
        "means": size * rng.uniform([-1, -1, 2], [1, 1, 4], (num_gaussians, 3)),
        "quats": rng.normal(size=(num_gaussians, 4)),
        "scales": size * rng.uniform(0.02, 0.2, (num_gaussians, 3)),
        "opacities": rng.uniform(0.2, 0.9, num_gaussians),
        "colors": rng.uniform(size=(num_gaussians, 3)),
    }
    return ss.Gaussians.from_rgb(**{name: jnp.asarray(x, jnp.float32) for name, x in values.items()})


def frame(origin=(0.0, 0.0, 0.0)):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
    pose[:3, 3] = origin
    return StreamFrame.at_camera(pose, scale=2.0, near=0.5, far=8.0)


@pytest.mark.parametrize("size", [1e-4, 1.0, 1e4])
def test_splats_equal_the_gaussians_in_16_bits_at_any_size(size):
    gaussians = scene(size=size)
    unit = median_size(gaussians)
    splats = visible_splats(gaussians, unit, max_gaussians=1000)
    rotations = Rotation.from_quat(np.asarray(gaussians.quats)[:, [1, 2, 3, 0]]).as_matrix()
    variances = np.asarray(gaussians.scales, np.float64) ** 2
    wanted = np.einsum("nij,nj,nkj->nik", rotations, variances, rotations)
    largest = np.abs(wanted).max(axis=(1, 2), keepdims=True)
    sent = splats.covariances.astype(np.float16).astype(np.float64) * unit**2
    np.testing.assert_allclose(sent / largest, wanted / largest, atol=2 * HALF_PRECISION)
    np.testing.assert_allclose(splats.centers * unit, gaussians.means, rtol=1e-5, atol=1e-6 * size)
    np.testing.assert_allclose(splats.rgbs, np.clip(0.5 + 0.28209479 * np.asarray(gaussians.sh[:, 0]), 0, 1), atol=1e-6)
    np.testing.assert_array_equal(splats.opacities[:, 0], gaussians.opacities)


def test_invisible_gaussians_are_dropped_and_huge_ones_cut():
    gaussians = scene()
    means = gaussians.means.at[0, 0].set(np.nan)
    scales = gaussians.scales.at[1].set(np.inf).at[2].set(1e6)
    opacities = gaussians.opacities.at[3].set(0.0).at[4].set(1 / 256)
    splats = visible_splats(
        replace(gaussians, means=means, scales=scales, opacities=opacities), 0.1, max_gaussians=1000
    )
    assert len(splats.centers) == 50 - 4
    assert all(np.isfinite(x).all() for x in vars(splats).values())
    assert np.isfinite(splats.covariances.astype(np.float16)).all()
    np.testing.assert_allclose(np.linalg.eigvalsh(splats.covariances[0]), MAX_SIGMA**2, rtol=1e-5)


def test_too_many_gaussians_are_evenly_subsampled():
    gaussians = scene()
    all_of_them, some = (
        visible_splats(gaussians, 1.0, max_gaussians=50),
        visible_splats(gaussians, 1.0, max_gaussians=17),
    )
    places = [int(np.flatnonzero((all_of_them.centers == center).all(axis=1))[0]) for center in some.centers]
    assert len(places) == 17 and places[0] == 0 and places[-1] == 49
    assert set(np.diff(places)) == {3, 4}
    growth = some.covariances / all_of_them.covariances[places]
    np.testing.assert_allclose(growth, 50 / 17, rtol=1e-5)  # as many times the area as there are times fewer


def test_a_subsampled_surface_keeps_what_it_covers():
    """A wall of Gaussians, a pixel apart, from which three of four are left out."""
    side, camera = 64, Camera(viewmats=jnp.eye(4), Ks=jnp.diag(jnp.array([64.0, 64, 1])), width=48, height=48)
    x, y = np.meshgrid(*[np.arange(side) / 64] * 2)
    wall = Gaussians.from_rgb(
        means=jnp.asarray(np.stack([x.ravel(), y.ravel(), np.ones(side**2)], -1), jnp.float32),
        quats=jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0]), (side**2, 1)),
        scales=jnp.full((side**2, 3), 0.8 / 64),
        opacities=jnp.full(side**2, 0.7),
        colors=jnp.full((side**2, 3), 0.5),
    )
    shuffled = jax.tree.map(lambda a: a[np.random.default_rng(0).permutation(side**2)], wall)
    covered = {}
    for most in (side**2, side**2 // 4):
        splats = visible_splats(shuffled, 1.0, max_gaussians=most)
        sizes = np.sqrt(np.diagonal(splats.covariances, axis1=1, axis2=2))
        n = len(sizes)
        shown = Gaussians.from_rgb(
            means=jnp.asarray(splats.centers),
            quats=jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0]), (n, 1)),
            scales=jnp.asarray(sizes, jnp.float32),
            opacities=jnp.asarray(splats.opacities[:, 0]),
            colors=jnp.full((n, 3), 0.5),
        )
        covered[most] = float(ss.render(shown, camera).alpha.mean())
    all_of_them, some = covered.values()
    assert all_of_them > 0.97 and some > 0.9


def test_an_empty_scene_has_a_size_and_nothing_to_send():
    nothing = replace(scene(), opacities=jnp.zeros(50))
    assert median_size(nothing) == 1.0 and len(visible_splats(nothing, 1.0, max_gaussians=10).centers) == 0
    assert camera_before(nothing) is None


def delta(rows, seed):
    rng = np.random.default_rng(seed)
    gaussians = scene(2 * len(rows))
    return SceneDelta(
        np.asarray(rows, np.int32),
        replace(gaussians, opacities=jnp.asarray(rng.uniform(0.2, 0.9, 2 * len(rows)), jnp.float32)),
        8,
        rng.uniform(0.2, 0.9, 2 * len(rows)).astype(np.float32),
    )


def test_a_growing_run_is_what_its_deltas_add_up_to(tmp_path):
    origin = (5e6, 0.0, 1.0)  # so far that positions are counted from an offset
    header, source = {"frame": frame(origin).to_dict()}, GrowingScene(RunFolder(tmp_path))
    assert source.changed() is None and source.start_camera() is None
    deltas = [delta([0, 1], 1), delta([1, 2, 5], 2), delta([0], 3)]
    save_delta(tmp_path / "deltas" / "000004.npz", deltas[0], header)
    first = source.changed()
    assert first is not None and source.changed() is None
    for number, more in enumerate(deltas[1:], start=2):
        save_delta(tmp_path / "deltas" / f"{4 * number:06d}.npz", more, header)
    found = source.changed()
    known = None
    for part in deltas:
        known = apply_delta(known, part)
    known = jax.tree.map(jnp.asarray, known)
    wanted = frame(origin).gaussians_to_capture(known, offset=frame(origin).offset)
    for name in ("means", "quats", "scales", "opacities", "sh"):
        np.testing.assert_array_equal(getattr(found.gaussians, name), getattr(wanted, name))
    # Started anew: what the old run had is forgotten.
    for path in (tmp_path / "deltas").iterdir():
        path.unlink()
    save_delta(tmp_path / "deltas" / "000004.npz", deltas[1], header)
    anew = source.changed()
    assert anew is not None
    np.testing.assert_array_equal(np.asarray(anew.gaussians.opacities) > 0, np.repeat([0, 1, 1, 0, 0, 1, 0, 0], 2) > 0)


def test_a_growing_run_is_shown_at_its_middle_exposure(tmp_path):
    header, source = {"frame": frame().to_dict()}, GrowingScene(RunFolder(tmp_path))
    save_delta(tmp_path / "deltas" / "000004.npz", delta([0, 1], 1), header)
    before = source.changed()
    save_delta(tmp_path / "deltas" / "000008.npz", delta([2], 2), header | {"exposure": [3.0, 2.0, 0.5]})
    after = source.changed()
    colors = [0.5 + 0.28209479 * np.asarray(x.gaussians.sh[:4, 0], np.float64) for x in (before, after)]
    np.testing.assert_allclose(colors[1], colors[0] * [3.0, 2.0, 0.5], atol=1e-6)


def test_a_run_that_starts_anew_while_it_is_read_is_read_again(tmp_path, monkeypatch):
    header, source = {"frame": frame().to_dict()}, GrowingScene(RunFolder(tmp_path))
    for number in (1, 2):
        save_delta(tmp_path / "deltas" / f"{4 * number:06d}.npz", delta([0, 1], number), header)

    def vanish(path):
        if path.name == "000008.npz":
            path.unlink()
        return load_delta(path)

    monkeypatch.setattr("ssplat_jax.viewer.scene_sources.load_delta", vanish)
    assert source.changed() is None
    found = source.changed()
    assert found is not None
    np.testing.assert_array_equal(found.gaussians.opacities[:4], delta([0, 1], 1).gaussians.opacities)
    (tmp_path / "deltas" / "000012.npz").write_bytes(b"damaged")
    with pytest.raises(StorageError, match=r"000012\.npz"):
        source.changed()


def test_a_scene_file_is_read_again_when_it_is_written_again(tmp_path):
    file = tmp_path / "scene.ply"
    ss.save_ply(file, scene(5))
    source = open_source(tmp_path)
    assert isinstance(source, SceneFile) and source.start_camera() is None
    assert source.changed().gaussians.num_gaussians == 5 and source.changed() is None
    ss.save_ply(file, scene(7))
    assert source.changed().gaussians.num_gaussians == 7
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])  # by a program that is still writing
    assert source.changed() is None and source.at(1).gaussians.num_gaussians == 7
    with pytest.raises(InputError):  # nobody has gone on writing
        source.changed()
    ss.save_ply(file, scene(6))
    assert source.changed().gaussians.num_gaussians == 6
    file.unlink()
    assert source.changed() is None  # shown on


def test_a_scene_stays_until_the_next_metrics_are_there(tmp_path):
    """A run that ends again removes its metrics, writes its scene, and then writes its metrics."""
    file, metrics = tmp_path / "scene.ply", tmp_path / "metrics.json"
    ss.save_ply(file, scene(5))
    metrics.write_text(json.dumps({"scene_exposure": [2.0, 1.0, 1.0]}))
    source, shown = open_source(tmp_path, one_exposure=True), SceneFile(file)
    first = source.changed().gaussians
    assert shown.changed().exposure[0] == 2.0
    metrics.unlink()
    assert source.changed() is None
    ss.save_ply(file, scene(7))
    assert source.changed() is None and shown.changed() is None
    assert source.at(1).gaussians is first
    metrics.write_text(json.dumps({"scene_exposure": [4.0, 2.0, 1.0]}))
    literal, exposed = source.changed().gaussians, shown.changed()
    np.testing.assert_array_equal(exposed.exposure, [4.0, 2.0, 1.0])
    colors = [0.5 + 0.28209479 * np.asarray(x.sh[:, 0], np.float64) for x in (literal, exposed.gaussians)]
    np.testing.assert_allclose(colors[0] * [4.0, 2.0, 1.0], colors[1], atol=1e-6)


@pytest.mark.parametrize("suffix", [".sog", ".spz", ".glb"])
def test_a_scene_file_of_any_format_is_shown(tmp_path, suffix):
    save_gaussians(tmp_path / f"a{suffix}", scene(5))
    source = open_source(tmp_path / f"a{suffix}")
    assert source.changed().gaussians.num_gaussians == 5 and source.changed() is None


def test_viewing_starts_at_the_first_camera_of_the_run(tmp_path):
    ss.save_ply(tmp_path / "scene.ply", scene(5))
    metrics, source = tmp_path / "metrics.json", open_source(tmp_path)
    metrics.write_text(json.dumps({"stream_frame": frame((1.0, 2.0, 3.0)).to_dict()}))
    np.testing.assert_allclose(source.start_camera().position, [1.0, 2.0, 3.0])
    for other in ("", "{", "[]", "{}", '{"stream_frame": null}', '{"stream_frame": {"rotation": 1}}', "\x00"):
        metrics.write_text(other)
        assert source.start_camera() is None


def test_viewing_a_finished_run_starts_in_the_middle_of_its_path(tmp_path):
    ss.save_ply(tmp_path / "scene.ply", scene(5))
    far = frame((1e6, 2.0, 3.0))
    assert far.offset[0] > 1e5
    (tmp_path / "metrics.json").write_text(json.dumps({"stream_frame": far.to_dict()}))
    rng, folder = np.random.default_rng(0), RunFolder(tmp_path)
    poses = {number: np.eye(4) for number in (4, 0, 3, 1, 2)}  # in the order of streaming
    for number, pose in poses.items():
        pose[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        pose[:3, 3] = [1e6 + number, 5.0, 6.0]
    views = [RecordedView(number, pose, np.eye(3), np.ones(3), b"") for number, pose in poses.items()]
    save_chunk_record(folder.chunk_record(5), ChunkRecord(5, (32, 24), tuple(views), 0.1, 0.5, 5, None))
    camera = open_source(tmp_path).start_camera()
    np.testing.assert_allclose(camera.position, np.array([1e6 + 2, 5.0, 6.0]) - far.offset)
    distance = np.linalg.norm(first_camera(far).look_at - first_camera(far).position)
    np.testing.assert_allclose(camera.look_at, camera.position + distance * poses[2][:3, 2])
    np.testing.assert_allclose(camera.up, -poses[2][:3, 1])


def test_a_browser_starts_at_the_first_camera_of_the_stream():
    camera = first_camera(frame((1.0, 2.0, 3.0)))
    rotation = frame().rotation
    np.testing.assert_allclose(camera.position, [1.0, 2.0, 3.0])
    # The middle depth of 0.5 to 8 stream units is 2 of them, 1 of the capture's.
    np.testing.assert_allclose(camera.look_at, camera.position + rotation @ [0, 0, 1.0])
    np.testing.assert_allclose(camera.up, rotation @ [0, -1, 0])


@pytest.mark.parametrize("name", ["nowhere", "empty", "nowhere.ply"])
def test_a_path_without_a_scene_is_refused(name, tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"wanted a scene file, or the folder"):
        open_source(tmp_path / name)


def some_stage(folder, num_gaussians=50):
    ss.save_ply(folder / "scene.ply", scene(num_gaussians))
    stage = Stage(open_source(folder), max_gaussians=1000)
    stage.refresh()
    return stage


def test_a_missing_viser_is_refused_with_the_remedy(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(InputError, match=r'pip install "ssplat-jax\[viewer\]"'):
        Viewer(some_stage(tmp_path), host="127.0.0.1", port=8080)


@pytest.mark.parametrize(
    ("host", "port"), [("192.0.2.7", 8080), ("nosuch.invalid", 8080), ("127.0.0.1", 70000), ("127.0.0.1", 0)]
)
def test_an_unusable_address_is_refused_at_once(host, port, tmp_path):
    with pytest.raises(InputError, match=rf"view: cannot listen on {host}:{port} \(.*\); choose another"):
        Viewer(some_stage(tmp_path), host=host, port=port)


def test_an_empty_folder_of_deltas_hides_no_scene(tmp_path):
    (tmp_path / "deltas").mkdir()
    assert isinstance(open_source(tmp_path), GrowingScene)
    (tmp_path / "scene.ply").write_bytes(b"")
    assert isinstance(open_source(tmp_path), SceneFile)


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_the_server_answers_at_its_url_and_prints_nothing(tmp_path, capsys):
    pytest.importorskip("viser")
    viewer = Viewer(some_stage(tmp_path), host="127.0.0.1", port=free_port())
    try:
        assert viewer.url.startswith("http://localhost:")
        with urllib.request.urlopen(viewer.url, timeout=20) as page:
            assert page.status == 200
        viewer.update()
        assert viewer.browsers == []
    finally:
        viewer.close()
    assert capsys.readouterr() == ("", "")


@pytest.mark.slow
def test_the_command_shows_a_file_until_it_is_interrupted(tmp_path):
    pytest.importorskip("viser")
    ss.save_ply(tmp_path / "scene.ply", scene())
    command = "import sys; from ssplat_jax.commands.main import main; sys.argv[0] = 'ssplat'; main()"
    arguments = ("view", str(tmp_path / "scene.ply"), "--port", str(free_port()))
    with subprocess.Popen([sys.executable, "-c", command, *arguments], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        line = next(line for line in process.stdout if line.startswith("http://localhost:"))
        with urllib.request.urlopen(line.split()[0], timeout=20) as page:
            assert page.status == 200
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=60) == 130
