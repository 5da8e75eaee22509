"""The scripts of docs/examples run as a person would copy them, on small scenes."""

import importlib.util
import json

import jax
import numpy as np
import pytest
from PIL import Image

import ssplat_jax as ss
from ssplat_jax.data import open_capture as captures
from ssplat_jax.data.readers.frame_list import FrameList, Intrinsics, Reader
from tests.docs.test_docs import ROOT
from tests.model.small import random_params
from tests.streaming.narrow_model import FEW_GAUSSIANS

FOLDER = ROOT / "docs" / "examples"
SMALL = "procedural:room?frames=8&size=64x48"

pytestmark = pytest.mark.usefixtures("compiled_plainly", "registered_networks")


def script(name: str):
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def narrow(monkeypatch):
    """A narrow model without a history in place of the shipped one."""
    config = FEW_GAUSSIANS.replace(hpda=False, cgfi=False)
    monkeypatch.setattr(ss, "preset", lambda name: config)
    monkeypatch.setattr(ss, "load_params", lambda name: random_params(config))


def test_step_in_my_code_writes_a_scene(tmp_path, narrow):
    script("step_in_my_code").main(SMALL, tmp_path / "scene.ply")
    assert (tmp_path / "scene.ply").stat().st_size > 10_000


@pytest.mark.slow  # tests/streaming has the law; the step is compiled anew
def test_two_streams_fill_two_caches():
    voxels = script("two_streams_vmap").main([SMALL, SMALL.replace("room", "orbit")], 2)
    assert min(voxels) > 100 and voxels[0] != voxels[1]


def test_a_network_of_ones_own_streams():
    assert 0.2 < script("own_depth_network").main() <= 1


def test_a_live_camera_is_streamed(tmp_path, narrow, programs_shared, monkeypatch):
    monkeypatch.chdir(tmp_path)
    gaussians = script("live_camera").main("procedural:room?frames=6&size=64x48")
    assert int((np.asarray(gaussians.opacities) > 0).sum()) > 500
    assert (tmp_path / "live.ply").exists()


def test_gaussians_are_fitted_to_an_image():
    with jax.numpy_dtype_promotion("standard"):  # as users have it: optax relies on it
        before, after = script("render_and_differentiate").main(30)
    assert after < 0.4 * before


@pytest.mark.slow  # a training step of its own
def test_training_with_optax_takes_steps():
    with jax.numpy_dtype_promotion("standard"):
        losses = script("train_with_optax").main(2)
    assert np.isfinite(losses).all()


def test_a_capture_reader_of_ones_own_opens_its_captures(tmp_path, monkeypatch):
    """As docs/extending.md has it: here a folder with toy.json, which holds the camera's x by image."""

    def read(path, convention):
        facts, frames = json.loads((path / "toy.json").read_text()), FrameList(path, convention)
        for name, x in facts.items():
            pose = np.eye(4)
            pose[0, 3] = x
            intrinsics = Intrinsics(fx=40.0, fy=40.0, cx=16.0, cy=12.0)
            frames.add(name, path / name, pose, intrinsics, f"{path / 'toy.json'}: {name}")
        return frames.listing(len(facts), "image")

    toy = Reader("toy", lambda path: (path / "toy.json").is_file(), read)
    monkeypatch.setattr(captures, "CAPTURE_READERS", (*captures.CAPTURE_READERS, toy))
    for i in range(3):
        Image.new("RGB", (32, 24), (80 * i, 0, 0)).save(tmp_path / f"{i}.png")
    (tmp_path / "toy.json").write_text(json.dumps({f"{i}.png": 0.1 * i for i in range(3)}))
    capture = ss.open_capture(tmp_path)
    assert (capture.format, len(capture), capture.image(2).shape) == ("toy", 3, (24, 32, 3))
    np.testing.assert_allclose(capture.camtoworlds[:, 0, 3], [0.0, 0.1, 0.2])
