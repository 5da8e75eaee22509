"""Training's changes of each stage: weight decay shortens, learning turns."""

import math

import jax
import numpy as np
import pytest

from ssplat_jax.config import preset
from ssplat_jax.model import init_params
from ssplat_jax.storage.stage_changes import stage_changes, start_of, trainings
from ssplat_jax.storage.weights import describe_weights, load_params, save_weights
from tests.streaming.narrow_model import NARROW


def test_decay_shortens_and_learning_turns():
    rng = np.random.default_rng(0)
    start = {"a": {"w": rng.normal(size=(7, 3)), "b": rng.normal(size=5)}, "b": {"w": rng.normal(size=4)}, "none": {}}
    # A vector of the start's length, perpendicular to it over both leaves of the stage.
    across = {"w": rng.normal(size=(7, 3)), "b": rng.normal(size=5)}
    length2 = sum(np.sum(x**2) for x in start["a"].values())
    overlap = sum(np.sum(across[n] * start["a"][n]) for n in across) / length2
    across = {n: across[n] - overlap * start["a"][n] for n in across}
    scale = math.sqrt(length2 / sum(np.sum(x**2) for x in across.values()))
    angle = 0.3
    turned = {n: math.cos(angle) * start["a"][n] + math.sin(angle) * scale * across[n] for n in across}
    params = {"a": turned, "b": {"w": 0.9 * start["b"]["w"]}, "none": {}}
    learned, decayed = stage_changes(params, start)
    assert (learned.name, learned.num_params, decayed.name, decayed.num_params) == ("a", 26, "b", 4)
    assert learned.distance == pytest.approx(2 * math.sin(angle / 2)) and learned.turn == pytest.approx(math.sin(angle))
    assert decayed.distance == pytest.approx(0.1) and decayed.turn == pytest.approx(0, abs=1e-12)


def test_a_stage_that_starts_at_zero():
    zero, one = {"a": {"w": np.zeros(3)}}, {"a": {"w": np.ones(3)}}
    assert [(c.distance, c.turn) for c in stage_changes(zero, zero)] == [(0, 0)]
    assert [(c.distance, c.turn) for c in stage_changes(one, zero)] == [(math.inf, 1)]
    assert [(c.distance, c.turn) for c in stage_changes(zero, one)] == [(1, 0)]  # none of it is left


def test_the_start_is_that_of_the_recipes_seed(tmp_path):
    params = init_params(jax.random.key(3), NARROW)
    save_weights(tmp_path / "w.npz", params, NARROW, {"recipe": {"seed": 3}, "steps": 0})
    facts = describe_weights(str(tmp_path / "w.npz"))
    assert facts.config == NARROW and facts.num_bytes == (tmp_path / "w.npz").stat().st_size
    changes = stage_changes(load_params(str(tmp_path / "w.npz")), start_of(facts.config, facts.provenance))
    assert max(change.distance for change in changes) < 1e-3  # float16 on disk
    other = stage_changes(params, start_of(NARROW, {}))  # seed 0
    assert min(c.distance for c in other if c.num_params > 1) > 0.5


def test_a_stage_that_a_later_training_added_is_compared_with_its_own_start():
    first, later = init_params(jax.random.key(3), NARROW), init_params(jax.random.key(7), NARROW)
    provenance = {"recipe": {"seed": 7}, "fresh": ["cgfi"], "before": {"recipe": {"seed": 3}}}
    changes = stage_changes(first | {"cgfi": later["cgfi"]}, start_of(NARROW, provenance))
    assert len(changes) > 3 and max(change.distance for change in changes) == 0
    assert trainings(provenance) == [{"recipe": {"seed": 3}}, provenance]


def test_matcher_and_evidence_head_of_the_shipped_weights_are_trained_and_other_stages_are_not():
    facts = describe_weights("tiny")
    assert facts.config == preset("tiny") and facts.num_bytes < 8e6
    params = load_params("tiny")
    start = jax.tree.map(lambda x: x, start_of(facts.config, facts.provenance))
    turns = {change.name: change.turn for change in stage_changes(params, start)}
    trained = ("encoder", "cost_volume", "evidence")
    assert min(turns[name] for name in trained) > 0.3
    assert max(turns[name] for name in turns if name not in trained) < 0.01
