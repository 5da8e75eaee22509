"""Training of the refiner: views that it was not shown gain, and the same seed gives the same network."""

from importlib import resources
from pathlib import Path

import jax
import numpy as np
import pytest

from ssplat_jax.checkpoint.weights import load_params
from ssplat_jax.commands.train_command import Train
from ssplat_jax.config import preset
from ssplat_jax.errors import InputError
from ssplat_jax.refinement.refiner_weights import init_refiner, load_refiner
from ssplat_jax.streaming.streamsplat import StreamSplat
from ssplat_jax.train.refiner_training import RefinerRecipe, train_refiner

SHIPPED = Path(str(resources.files("ssplat_jax") / "weights" / "tiny.npz"))
RECIPE = RefinerRecipe(
    rounds=1,
    steps=40,
    views=(4,),
    width=64,
    procedural=("procedural:room?frames=12",),
    learning_rate=0.01,
    ema_decay=0.5,
)


@pytest.fixture(scope="module", autouse=True)
def standard_promotion():
    """Allows type promotion: optax raises a float to an int32 power in Adam's bias correction."""
    with jax.numpy_dtype_promotion("standard"):
        yield


def trained(seed: int = 0):
    recipe = RefinerRecipe(**{**vars(RECIPE), "seed": seed})
    return train_refiner(StreamSplat(preset("tiny")), load_params("tiny"), [], recipe)


def test_views_that_were_not_compared_gain_from_round_to_round():
    network, facts = trained()
    for scores in facts["rounds"]:
        assert scores["after"]["shown_psnr"] > scores["before"]["shown_psnr"] + 0.1
        assert scores["after"]["black_psnr"] > scores["before"]["black_psnr"] + 0.1
    assert facts["scenes"] == ["procedural-room, stride 1"]
    moved = [not np.array_equal(a, b) for a, b in zip(*map(jax.tree.leaves, (network, init_refiner(0))), strict=True)]
    assert all(moved)
    again, _ = trained()
    jax.tree.map(np.testing.assert_array_equal, again, network)


def test_the_command_writes_a_file_that_loads(tmp_path, monkeypatch, capsys):
    short = RefinerRecipe(**{**vars(RECIPE), "rounds": 1, "steps": 2})
    monkeypatch.setattr("ssplat_jax.train.refiner_training.RefinerRecipe", lambda seed: short)
    assert Train(out=tmp_path, recipe="refiner", init_weights=SHIPPED, scale_steps=0.5).run() == 0
    assert "after 1 steps" in capsys.readouterr().out
    assert load_refiner(tmp_path / "refiner.npz").keys() == init_refiner().keys()


@pytest.mark.parametrize(
    ("options", "named"),
    [({}, "--init-weights"), ({"init_weights": SHIPPED, "save_every": 10}, "--save-every")],
)
def test_options_that_do_not_fit_the_recipe_are_refused(options, named, tmp_path):
    with pytest.raises(InputError, match=named):
        Train(out=tmp_path / "out", recipe="refiner", **options).run()
    assert not (tmp_path / "out").exists()
