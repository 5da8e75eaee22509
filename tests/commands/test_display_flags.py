"""`--over-black` and `--one-exposure` of `render` and `view`: together they give the image of the literal score."""

import json
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import SH_C0, scale_colors
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.scene_files.formats import load_scene, save_gaussians
from ssplat_jax.storage.saved_states import load_state
from ssplat_jax.storage.weights import save_weights
from ssplat_jax.viewer.scene_sources import open_source
from tests.commands.test_cli import few_pivots, make_capture, run  # noqa: F401
from tests.streaming.narrow_model import NARROW

SIZE = (64, 48)
MIDDLE = [0.5, 0.8, 1.6]
LEVEL = 1 / 255


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Folder of a capture and its run, and the PSNRs of the run."""
    folder = tmp_path_factory.mktemp("finished")
    weights, out = folder / "narrow.npz", folder / "out"
    save_weights(weights, StreamSplat(NARROW).init(jax.random.key(0)), NARROW, {})
    capture = make_capture(folder / "capture", num_frames=8, size=SIZE)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("ssplat_jax.streaming.session.MIN_DECODED_PIVOTS", 1 << 11)
        assert run("run", str(capture), "--out", str(out), "--deltas", "--weights", str(weights), "--quiet") == 0
    metrics = json.loads((out / "metrics.json").read_text())
    before = np.array(metrics["scene_exposure"])
    stored = scale_colors(load_scene(out / "scene.ply"), jnp.asarray(np.array(MIDDLE) / before, jnp.float32))
    save_gaussians(out / "scene.ply", stored)
    (out / "metrics.json").write_text(json.dumps(metrics | {"scene_exposure": MIDDLE}))
    return folder, metrics["seen_views"]


@pytest.fixture
def finished(folder, tmp_path):
    """A run whose scene is stored at another exposure than that of its first views; the capture; the stored PSNRs."""
    held, scores = folder
    shutil.copytree(held, tmp_path / "held")
    return tmp_path / "held" / "out", tmp_path / "held" / "capture", scores


def pixels(path):
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"), np.float64) / 255


def test_both_flags_render_the_literal_image(finished, tmp_path):
    out, capture, scores = finished
    pictures = tmp_path / "pictures"
    flags = ("--over-black", "--one-exposure", "--quiet")
    assert run("render", str(out), str(capture), *flags, "--out", str(pictures)) == 0
    assert len(scores) == 8
    for score in scores:
        i = score["frame"]
        error = pixels(pictures / "views" / f"{i:05d}.png") - pixels(capture / "images" / f"{i}.png")
        psnr = -10 * np.log10(np.mean(error**2))
        assert psnr == pytest.approx(score["literal"]["psnr"], abs=0.05)  # 8 bits


def test_exposure_of_a_file_without_its_run_is_refused(finished, tmp_path, capsys):
    out, capture, _ = finished
    alone = tmp_path / "alone"
    alone.mkdir()
    (alone / "scene.ply").write_bytes((out / "scene.ply").read_bytes())
    (out / "other.ply").write_bytes((out / "scene.ply").read_bytes())
    for scene in (alone, alone / "scene.ply", out / "other.ply"):
        assert run("render", str(scene), str(capture), "--one-exposure", "--out", str(tmp_path / "p")) == 2
        assert "--one-exposure: wanted the exposure" in capsys.readouterr().err
        with pytest.raises(InputError, match="--one-exposure"):
            open_source(scene, one_exposure=True).changed()
    assert not (tmp_path / "p").exists()


def constants(gaussians):
    """Colors from everywhere, sorted so that rows need not correspond."""
    return np.sort(0.5 + SH_C0 * np.asarray(gaussians.sh[:, 0], np.float64), axis=0)


def test_a_viewed_file_is_shown_at_the_exposure_asked_for(finished):
    out, *_ = finished
    middle, first = (open_source(out / "scene.ply", one_exposure=one).changed().gaussians for one in (False, True))
    np.testing.assert_allclose(constants(first) * MIDDLE, constants(middle), rtol=1e-4, atol=1e-5)


def test_followed_deltas_are_those_of_the_cache(finished):
    """The deltas of a run, at one exposure, are the cache's Gaussians in the capture's frame, unscaled."""
    out, *_ = finished
    cache, header = load_state(out / "state.npz")
    model, params = StreamSplat(NARROW), StreamSplat(NARROW).init(jax.random.key(0))
    params = jax.tree.map(lambda x: x.astype(jnp.float16).astype(jnp.float32), params)
    wanted = StreamFrame.from_dict(header["frame"]).gaussians_to_capture(model.decode(params, cache))
    shown = open_source(out, one_exposure=True).changed().gaussians
    colors = [constants(jax.tree.map(lambda x, g=g: x[np.asarray(g.opacities) > 0], g)) for g in (shown, wanted)]
    np.testing.assert_allclose(*colors, atol=LEVEL / 100)
