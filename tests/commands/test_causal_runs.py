"""`ssplat run --causal`: what a run has written does not depend on frames that come later."""

import json

import jax
import numpy as np
import pytest
from PIL import Image

from ssplat_jax.core.atomic import previous_path
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.storage.saved_states import load_state
from ssplat_jax.storage.weights import save_weights
from tests.commands.test_cli import few_pivots, make_capture, run  # noqa: F401
from tests.streaming.narrow_model import NARROW, assert_same_bits

SIZE = (64, 48)


@pytest.fixture
def weights(tmp_path):
    path = tmp_path / "narrow.npz"
    save_weights(path, StreamSplat(NARROW).init(jax.random.key(0)), NARROW, {})
    return str(path)


def replace_future(capture, first):
    """Gives a capture other images and poses from frame `first` on."""
    rng = np.random.default_rng(2)
    facts = json.loads((capture / "transforms.json").read_text())
    for entry in facts["frames"][first:]:
        entry["transform_matrix"][0][3] += 50.0
        noise = rng.integers(0, 255, (SIZE[1], SIZE[0], 3), dtype=np.uint8)
        Image.fromarray(noise).save(capture / entry["file_path"])
    (capture / "transforms.json").write_text(json.dumps(facts))


def deltas_of(out):
    return {path.name: path.read_bytes() for path in sorted((out / "deltas").glob("*.npz"))}


@pytest.mark.slow  # streaming/test_causal.py has the law
def test_a_replaced_future_changes_no_earlier_output(tmp_path, weights):
    written = []
    for name in ("here", "there"):
        capture, out = make_capture(tmp_path / name / "capture", num_frames=12, size=SIZE), tmp_path / name / "out"
        if name == "there":
            replace_future(capture, 8)
        arguments = ("--weights", weights, "--deltas", "--save-every", "1", "--quiet")
        assert run("run", str(capture), "--causal", "--out", str(out), *arguments) == 0
        written.append((deltas_of(out), load_state(previous_path(out / "state.npz"))))
    (here, state), (there, other) = written
    assert list(here) == list(there) == ["000004.npz", "000008.npz", "000012.npz"]
    assert here["000004.npz"] == there["000004.npz"] and here["000008.npz"] == there["000008.npz"]
    assert here["000012.npz"] != there["000012.npz"]
    assert_same_bits(state[0], other[0])  # after the second chunk
    assert all(state[1][fact] == other[1][fact] for fact in ("done", "frame", "exposures"))
    assert state[1]["done"] == 8


@pytest.mark.slow
def test_a_stopped_causal_run_continues_to_the_same_scene(tmp_path, weights):
    capture = str(make_capture(tmp_path / "capture", num_frames=12, size=SIZE))
    arguments = ("--causal", "--weights", weights, "--save-every", "1", "--quiet")
    whole, stopped = tmp_path / "whole", tmp_path / "stopped"
    assert run("run", capture, "--out", str(whole), *arguments) == 0
    stopped.mkdir()
    (stopped / "state.npz").write_bytes(previous_path(whole / "state.npz").read_bytes())
    assert run("run", capture, "--out", str(stopped), *arguments) == 0
    assert (stopped / "scene.ply").read_bytes() == (whole / "scene.ply").read_bytes()
    frames = [json.loads((out / "metrics.json").read_text())["stream_frame"] for out in (whole, stopped)]
    assert frames[0] == frames[1]
