"""Weights files are read back exactly, or refused."""

import jax
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from ssplat_jax.config import preset
from ssplat_jax.core.errors import InputError
from ssplat_jax.model.network import init_params
from ssplat_jax.storage.weights import (
    WeightsFacts,
    changed_shares,
    check_params,
    describe_weights,
    load_params,
    load_weights,
    save_weights,
)
from tests.model.small import random_params
from tests.streaming.narrow_model import NARROW


def test_weights_are_read_back_as_rounded_to_float16(tmp_path):
    save_weights(tmp_path / "w.npz", random_params(NARROW), NARROW, {"steps": 3})
    loaded, config = load_weights(tmp_path / "w.npz")
    assert config == NARROW
    wanted = jax.tree.map(lambda x: np.asarray(x, np.float16), random_params(NARROW))
    jax.tree.map(np.testing.assert_array_equal, loaded, wanted)
    assert {str(x.dtype) for x in jax.tree.leaves(loaded)} == {"float32"}


def test_weights_of_another_width_are_refused_by_name(tmp_path):
    save_weights(tmp_path / "w.npz", random_params(NARROW), NARROW.replace(token_width=32), {})
    with pytest.raises(InputError, match="must be"):
        load_params(str(tmp_path / "w.npz"))


def test_weights_may_have_stages_that_are_switched_off():
    """`--set mixer_blocks=0` switches a stage off; missing stages are still refused."""
    check_params(random_params(NARROW), NARROW.replace(mixer_blocks=0), "here")
    with pytest.raises(InputError, match=r"here.*mixer"):
        check_params(random_params(NARROW), NARROW.replace(mixer_blocks=NARROW.network.mixer_blocks + 1), "here")


def test_training_changes_a_stage_and_decay_does_not():
    """Also where a later training added a stage, which is compared with its own start."""
    first, later = (init_params(jax.random.key(seed), NARROW) for seed in (3, 7))
    params = jax.tree.map(lambda x: 0.9 * x, first)
    rng = np.random.default_rng(0)
    params["encoder"] = jax.tree.map(lambda x: x + 0.1 * rng.normal(size=x.shape), params["encoder"])
    provenance = {"recipe": {"seed": 7}, "fresh": ["evidence"], "before": {"recipe": {"seed": 3}}}
    shares = changed_shares(params | {"evidence": later["evidence"]}, WeightsFacts(NARROW, provenance, 0))
    before, after = (np.asarray(ravel_pytree(tree["encoder"])[0], np.float64) for tree in (first, params))
    cosine = before @ after / np.linalg.norm(before) / np.linalg.norm(after)
    assert shares.pop("encoder") == pytest.approx(np.sqrt(1 - cosine**2), rel=1e-4)
    assert len(shares) > 3 and max(shares.values()) < 1e-6
    assert changed_shares(later, WeightsFacts(NARROW, provenance, 0))["encoder"] > 0.5


def test_matcher_anchor_and_evidence_head_of_the_shipped_weights_are_trained_and_other_stages_are_not():
    facts = describe_weights("tiny")
    assert facts.config == preset("tiny") and facts.num_bytes < 8e6
    shares = changed_shares(load_params("tiny"), facts)
    trained = ("encoder", "cost_volume", "hpda", "evidence")
    assert min(shares[name] for name in trained) > 0.3
    assert max(shares[name] for name in shares if name not in trained) < 0.01
