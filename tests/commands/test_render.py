"""`ssplat render`: pictures of a scene file from a capture's cameras, and a film."""

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

import ssplat_jax as ss
from ssplat_jax.core.gaussians import mean_color
from ssplat_jax.core.pytree import replace
from ssplat_jax.data.capture import Capture
from ssplat_jax.evaluation import scoring
from ssplat_jax.rasterizer import Effects, fill_holes
from ssplat_jax.runs import scene_outputs
from ssplat_jax.runs.open_run import save_poses
from ssplat_jax.scene_files.formats import save_gaussians
from ssplat_jax.storage.run_folder import RunFolder
from ssplat_jax.viewer import stage
from tests.commands.command_fixture import make_capture, run
from tests.data.capture_fixture import with_poses

LEVEL = 1.0 / 255
FILM_DB = 38.0  # x264's losses, of the brightness: colors have half the resolution


def scene(num_gaussians=60):
    rng = np.random.default_rng(3)
    values = {
        "means": rng.uniform([-1, -1, -4], [1, 1, -2], (num_gaussians, 3)),
        "quats": rng.normal(size=(num_gaussians, 4)),
        "scales": rng.uniform(0.02, 0.2, (num_gaussians, 3)),
        "opacities": rng.uniform(0.2, 0.9, num_gaussians),
        "colors": rng.uniform(size=(num_gaussians, 3)),
    }
    return ss.Gaussians.from_rgb(**{name: jnp.asarray(x, jnp.float32) for name, x in values.items()})


def picture(path):
    with Image.open(path) as image:
        return np.asarray(image, np.float64) / 255


@pytest.fixture
def capture(tmp_path):
    return make_capture(tmp_path / "capture", num_frames=3, size=(48, 32))


def wanted(capture, gaussians, i, antialias, *, filled=True):
    opened = capture if isinstance(capture, Capture) else ss.open_capture(capture)
    out = ss.render(gaussians, opened.camera(i), effects=Effects(antialias=antialias))
    return np.clip(fill_holes(out.color, out.alpha, mean_color(gaussians)) if filled else out.color, 0, 1)


def test_pictures_are_what_the_cameras_see_of_the_refined_scene(tmp_path, capture):
    ss.save_ply(tmp_path / "run" / "scene.ply", scene(5))
    ss.save_ply(tmp_path / "run" / "refined.ply", scene())
    out = tmp_path / "pictures"
    assert run("render", tmp_path / "run", capture, "--stride", "2", "--out", out, "--quiet") == 0
    assert sorted(path.name for path in (out / "views").iterdir()) == ["00000.png", "00002.png"]
    loaded = ss.load_ply(tmp_path / "run" / "refined.ply")
    for i in (0, 2):
        found = picture(out / "views" / f"{i:05d}.png")
        np.testing.assert_allclose(found, wanted(capture, loaded, i, "mip"), atol=0.51 * LEVEL)
    assert np.abs(picture(out / "views" / "00000.png") - picture(out / "views" / "00002.png")).max() > 0.1
    # Fewer pictures than before: the others do not stay.
    assert run("render", tmp_path / "run", capture, "--out", out, "--max-views", "1", "--over-black", "--quiet") == 0
    (only,) = (out / "views").iterdir()
    np.testing.assert_allclose(picture(only), wanted(capture, loaded, 0, "mip", filled=False), atol=0.51 * LEVEL)


def test_a_run_is_drawn_from_its_adjusted_poses(tmp_path, capture):
    folder, opened = RunFolder(tmp_path / "run"), ss.open_capture(capture)
    ss.save_ply(folder.scene, scene())
    poses = opened.camtoworlds
    poses[:, :3, 3] += 0.1 * poses[:, :3, 0]
    save_poses(folder, opened.digest(range(3)), dict(enumerate(poses)))
    assert run("render", folder.path, capture, "--max-views", "1", "--out", tmp_path / "out", "--quiet") == 0
    expected = wanted(with_poses(opened, poses), ss.load_ply(folder.scene), 0, "mip")
    np.testing.assert_allclose(picture(tmp_path / "out" / "views" / "00000.png"), expected, atol=0.51 * LEVEL)


@pytest.mark.parametrize(("name", "antialias"), [("scene.ply", "classic"), ("scene.glb", "mip"), ("scene.sog", "mip")])
def test_a_scene_of_any_format_is_drawn_with_the_filter_that_it_names(tmp_path, capture, name, antialias):
    file = tmp_path / name
    if name == "scene.ply":
        ss.save_ply(file, replace(scene(), render_mode="default"))
        file.write_bytes(file.read_bytes().replace(b"comment SplatRenderMode: default\n", b""))
    else:
        save_gaussians(file, scene())
    assert run("render", file, capture, "--max-views", "1", "--out", tmp_path / "out", "--quiet") == 0
    loaded, found = ss.load_scene(file), picture(tmp_path / "out" / "views" / "00000.png")
    np.testing.assert_allclose(found, wanted(capture, loaded, 0, antialias), atol=0.51 * LEVEL)
    if name == "scene.ply":
        assert np.abs(found - wanted(capture, loaded, 0, "mip")).max() > 3 * LEVEL


def test_pictures_scores_and_the_viewer_draw_only_what_a_scene_calls_for(tmp_path, capture, monkeypatch):
    """A scene of degree 3 whose bands are empty is drawn with none."""
    degrees, opened = [], ss.open_capture(capture)
    splats = ss.Gaussians(**vars(scene()) | {"sh": jnp.zeros((60, 16, 3)).at[:, :1].set(scene().sh)})

    def drawn(scene, camera, *, effects):
        degrees.append(effects.sh_degree)
        return ss.render(scene, camera, effects=effects)

    for module in (scene_outputs, scoring, stage):
        monkeypatch.setattr(module, "render", drawn)
    ss.save_ply(tmp_path / "scene.ply", splats)
    assert run("render", tmp_path / "scene.ply", capture, "--max-views", "1", "--out", tmp_path / "out", "--quiet") == 0
    scoring.score_view(splats, opened, 0, opened.stream_frame(ss.preset("tiny")), {})
    stage.draw(splats, "color", opened.frames[0].camtoworld, opened.K(0), (48, 32))
    assert degrees == [0, 0, 0]


def test_a_film_goes_from_camera_to_camera(tmp_path, capture):
    av = pytest.importorskip("av")
    ss.save_ply(tmp_path / "scene.ply", scene())
    out = tmp_path / "out"
    arguments = ("--size", "45x31", "--out", out, "--quiet")
    assert run("render", tmp_path / "scene.ply", capture, "--film", "4", *arguments) == 0
    with av.open(str(out / "film.mp4")) as container:
        assert container.streams.video[0].average_rate == 24
        film = [frame.to_ndarray(format="rgb24") / 255 for frame in container.decode(video=0)]
    assert len(film) == 2 * 4 + 1
    views = [picture(out / "views" / f"{i:05d}.png")[:30, :44] for i in range(3)]
    brightness = np.array([0.2126, 0.7152, 0.0722])
    error = lambda a, b: -10 * np.log10(np.mean(((a - b) @ brightness) ** 2))  # noqa: E731
    for i, view in enumerate(views):
        assert error(film[4 * i], view) > FILM_DB
        assert np.abs((film[4 * i] - view).mean(axis=(0, 1))).max() < 3 * LEVEL
    # In between it shows neither of its ends.
    assert max(error(film[2], views[0]), error(film[2], views[1])) < min(error(film[0], views[0]), FILM_DB) - 5
    # Without a film, none of another scene stays.
    assert run("render", tmp_path / "scene.ply", capture, *arguments) == 0
    assert sorted(path.name for path in out.iterdir()) == ["views"]
