"""Training of the refiner: views that it was not shown gain, with the trained and with the shipped network."""

from importlib import resources
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.cache.key_views import empty_key_views
from ssplat_jax.commands.train_command import Train
from ssplat_jax.config import preset
from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.core.pytree import replace
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.data.split import interleaved_split
from ssplat_jax.evaluation.scoring import score_targets
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.refinement import refine_on_capture
from ssplat_jax.refinement.learned_pass import KIND, STEPS, init_refiner, load_refiner, no_errors
from ssplat_jax.refinement.refine_step import init_refinement
from ssplat_jax.storage.files import load_arrays
from ssplat_jax.storage.weights import load_params
from ssplat_jax.streaming.feed import feed_capture
from ssplat_jax.streaming.session import Session
from ssplat_jax.training.crops import Crops
from ssplat_jax.training.refiner_training import CONFIG, RefinerRecipe, TrainingScene, _after_pass

SHIPPED = Path(str(resources.files("ssplat_jax") / "weights" / "tiny.npz"))
RECIPE = RefinerRecipe(
    rounds=1,
    steps=40,
    views=(4,),
    scenes=Crops(procedural=("procedural:room?frames=12",), width=64, size=(16, 16)),
    learning_rate=0.01,
    ema_decay=0.5,
)


@pytest.mark.slow
def test_the_command_writes_a_network_with_which_other_views_gain(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("ssplat_jax.training.refiner_training.RefinerRecipe", lambda seed: RECIPE)
    assert Train(out=tmp_path, recipe="refiner", init_weights=SHIPPED, scale_steps=0.5).run() == 0
    assert "after 20 steps" in capsys.readouterr().out
    network = load_refiner(tmp_path / "refiner.npz")
    moved = [not np.array_equal(a, b) for a, b in zip(*map(jax.tree.leaves, (network, init_refiner(0))), strict=True)]
    assert all(moved)
    told = load_arrays(tmp_path / "refiner.npz", KIND)[1]["provenance"]
    assert told["scenes"] == ["procedural-room, stride 1"] and told["init_weights"] == "tiny.npz"
    before, after = (told["rounds"][0][name] for name in ("before", "after"))
    shown, black = (after[name] - before[name] for name in ("shown_psnr", "black_psnr"))
    weight = RECIPE.black_weight
    assert (1 - weight) * shown + weight * black > 0.1 and black > 0.1  # minus the loss


def test_a_pass_between_rounds_keeps_no_second_copy_of_the_scene():
    """A sample of every round is kept: with a copy each, scenes of captures took 23 GB."""
    gaussians = Gaussians(
        means=jnp.zeros((5, 3)), quats=jnp.ones((5, 4)), scales=jnp.ones((5, 3)), opacities=jnp.full(5, 0.5),
        sh=jnp.zeros((5, 1, 3)),
    )  # fmt: skip
    state = init_refinement(gaussians, config=CONFIG)
    seen = no_errors(state.start)
    seen = replace(seen, num_views=seen.num_views + 4, pixels=seen.pixels + 9, signed=seen.signed + 3)
    sample = TrainingScene(empty_key_views(1, 2, 2), 0, state, seen, [])
    network = jax.tree.map(lambda x: x + 0.1, init_refiner(0))
    after = _after_pass(network, sample)
    kept = [a is b for a, b in zip(*map(jax.tree.leaves, (after, state)), strict=True)]
    revised = [a is b for a, b in zip(*map(jax.tree.leaves, (after.change, state.change)), strict=True)]
    assert not any(revised) and sum(kept) == len(kept) - len(revised)
    assert not np.array_equal(after.change.logit_opacities, state.change.logit_opacities)


@pytest.mark.parametrize("seeds", [(12,), pytest.param((11, 12, 14), marks=pytest.mark.slow)])
def test_the_shipped_network_gains_on_rooms_that_it_has_not_seen(seeds):
    """Twelve views of 64 x 48 leave holes: the literal score gains in every room, the shown one in the mean."""
    model, params = StreamSplat(preset("tiny")), load_params("tiny")
    gains = []
    for seed in seeds:
        capture = open_capture(f"procedural:room?frames=16&seed={seed}", size=(64, 48))
        split = interleaved_split(len(capture), 1, 12)
        session, frame = Session(model, params), capture.stream_frame(model.config, split.context)
        exposures, _ = feed_capture(session, capture, split.context, frame)
        streamed = session.gaussians()
        refined = refine_on_capture(streamed, capture, split.context, frame, exposures, steps=STEPS)
        assert refined.report.num_steps == STEPS and refined.report.num_skipped == 0
        before, after = (
            score_targets(scene, capture, split.targets, frame, exposures) for scene in (streamed, refined.gaussians)
        )
        gains.append([after[column]["psnr"] - before[column]["psnr"] for column in ("literal", "shown")])
    literal, shown = np.transpose(gains)
    assert literal.min() > 1.0
    assert shown.min() > 0 and shown.mean() > 0.3


@pytest.mark.parametrize(
    ("options", "named"), [({}, "--init-weights"), ({"init_weights": SHIPPED, "save_every": 10}, "--save-every")]
)
def test_options_that_do_not_fit_the_recipe_are_refused(options, named, tmp_path):
    with pytest.raises(InputError, match=named):
        Train(out=tmp_path / "out", recipe="refiner", **options).run()
    assert not (tmp_path / "out").exists()
