"""Training of the refiner: views that it was not shown gain, with the trained and with the shipped network."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.commands.train_command import Train
from ssplat_jax.config import preset
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.data.split import interleaved_split
from ssplat_jax.evaluation.scoring import score_targets
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.refinement import refine_on_capture
from ssplat_jax.refinement.learned_pass import KIND, STEPS, init_refiner, load_refiner
from ssplat_jax.storage.files import load_arrays
from ssplat_jax.storage.weights import load_params
from ssplat_jax.streaming.feed import feed_capture
from ssplat_jax.streaming.session import Session
from ssplat_jax.training import recipe, refiner_training
from ssplat_jax.training.capture_mix import PhaseStart
from ssplat_jax.training.crops import Crops
from ssplat_jax.training.recipe import REFINER
from ssplat_jax.training.refiner_training import PassLoss, SceneErrors
from tests.training.test_train_command import SHIPPED

SCENES = Crops(procedural=("procedural:room?frames=12",), width=64, size=(16, 16))


def round_of(passes):
    """A short round."""
    samples = SceneErrors(passes, views=(4,), scenes=SCENES)
    return dataclasses.replace(
        REFINER.phases[0], steps=20, samples=samples, learning_rate=0.01, final_share=0.5, warmup_steps=5
    )


@pytest.mark.slow
def test_the_command_writes_a_network_with_which_other_views_gain(tmp_path, monkeypatch):
    streams, stream_scene = [], refiner_training.stream_scene

    def streamed_once(*given):
        streams.append(streams[0] if streams else stream_scene(*given))
        return streams[0]

    monkeypatch.setattr(refiner_training, "stream_scene", streamed_once)
    short = dataclasses.replace(REFINER, phases=(round_of(0), round_of(1)), ema_decay=0.5)
    monkeypatch.setitem(recipe.RECIPES, "refiner", short)
    assert Train(out=tmp_path, recipe="refiner", init_weights=SHIPPED).run() == 0
    assert len(streams) == 1  # for both rounds
    network = load_refiner(tmp_path / "refiner.npz")
    moved = [not np.array_equal(a, b) for a, b in zip(*map(jax.tree.leaves, (network, init_refiner(0))), strict=True)]
    assert all(moved)
    told = load_arrays(tmp_path / "refiner.npz", KIND)[1]["provenance"]
    assert told["fresh"] == ["refiner"] and told["init_weights"] == "tiny.npz"
    params, zero = load_params("tiny"), jax.tree.map(jnp.zeros_like, network)
    start = PhaseStart(StreamSplat(preset("tiny")), params | {"refiner": network}, None, 0, 40, print, {})
    for passes in range(2):
        make = round_of(passes).samples.open(start)
        loss = jax.jit(lambda refiner, batch: PassLoss()(start.model, {"refiner": refiner}, batch)[0])
        gains = [float(loss(zero, make(i, i)) - loss(network, make(i, i))) for i in range(6)]
        assert np.mean(gains) > (0.1 if passes == 0 else 0.0)


@pytest.mark.slow
def test_the_shipped_network_gains_on_rooms_that_it_has_not_seen():
    """Twelve views of 64 x 48 leave holes: the literal score gains in every room, the shown one in the mean."""
    model, params = StreamSplat(preset("tiny")), load_params("tiny")
    gains = []
    for seed in (11, 12, 14):
        capture = open_capture(f"procedural:room?frames=16&seed={seed}", size=(64, 48))
        split = interleaved_split(len(capture), 1, 12)
        session, frame = Session(model, params), capture.stream_frame(model.config, split.context)
        exposures, _ = feed_capture(session, capture, split.context, frame)
        streamed = session.gaussians()
        refined, _ = refine_on_capture(streamed, capture, split.context, frame, exposures, steps=STEPS)
        before, after = (
            score_targets(scene, capture, split.targets, frame, exposures) for scene in (streamed, refined)
        )
        gains.append([after[column]["psnr"] - before[column]["psnr"] for column in ("literal", "shown")])
    literal, shown = np.transpose(gains)
    assert literal.min() > 1.0 and shown.min() > 0 and shown.mean() > 0.3
