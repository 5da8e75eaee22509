"""The whole network: hard chunks and caches give finite tokens and gradients, and unusable views count as padding.

Hard cases of single stages are in tests/stability/test_*_hard_cases.py.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.core.pytree import replace
from tests.model import small

SUMS = 1e-6


HARD = {
    "an ordinary chunk": lambda c: c,
    "cameras at one place": lambda c: replace(c, viewmats=jnp.broadcast_to(jnp.eye(4), (3, 4, 4))),
    "a pure rotation": lambda c: replace(c, viewmats=small.turned(0.2)),
    "cameras back to back": lambda c: replace(c, viewmats=small.turned(np.pi)),
    "steps of a nanometre": lambda c: replace(c, viewmats=c.viewmats.at[:, 0, 3].multiply(1e-8)),
    "cameras far apart": lambda c: replace(c, viewmats=c.viewmats.at[:, 0, 3].multiply(1e5)),
    "one camera inside the scene": lambda c: replace(c, viewmats=c.viewmats.at[1, 2, 3].set(-3.0)),
    "black images": lambda c: replace(c, images=jnp.zeros_like(c.images)),
    "white images": lambda c: replace(c, images=jnp.ones_like(c.images)),
    "near equals far": lambda c: replace(c, far=c.near),
    "a huge range": lambda c: replace(c, near=jnp.float32(1e-4), far=jnp.float32(1e5)),
    "one valid view": lambda c: replace(c, valid=jnp.array([True, False, False])),
    "no valid view": lambda c: replace(c, valid=jnp.zeros(3, bool)),
    "a very long lens": lambda c: replace(c, Ks=c.Ks.at[:, 0, 0].set(1e5).at[:, 1, 1].set(1e5)),
}


def remembering(**changes):
    """The warm cache with changed fields of its live pivots."""

    def change():
        cache = small.warm_cache()
        alive = cache.alive
        fields = {}
        for name, value in changes.items():
            old = getattr(cache, name)
            mask = alive.reshape(alive.shape + (1,) * (old.ndim - 2))
            fields[name] = jnp.where(mask, jnp.broadcast_to(jnp.asarray(value, old.dtype), old.shape), 0)
        return replace(cache, **fields)

    return change


HARD_MEMORIES = {  # cache, and raw strength of the anchor
    "empty": (small.MODEL.init_cache, 0.0),
    "omega 0": (remembering(confidences=0.0), 0.0),
    "omega 1": (remembering(confidences=1.0), 0.0),
    "omega 1, gamma 1e6": (remembering(confidences=1.0), 1e6),
    "zero features": (remembering(feats=0.0, seeds=0.0), 0.0),
    "identical features": (remembering(feats=1.0, seeds=1.0), 0.0),
    "all at the near end": (remembering(means=[0.0, 0.0, 1.0]), 1e6),
    "all at the far end": (remembering(means=[0.0, 0.0, 6.0]), 1e6),
    "all at the first camera": (remembering(means=0.0), 1e6),
}


def check_prediction(given, cache, weights):
    """Checks values, gradients, distributions and ranges of a chunk, and the cache after it."""
    (value, (prediction, after)), gradient = small.program(weights, cache, given)
    assert small.finite((value, gradient, prediction, after))
    probs = np.asarray(prediction.distribution.probs, np.float64)
    assert (probs >= 0).all()
    np.testing.assert_allclose(probs.sum(-1), 1, rtol=0, atol=SUMS)
    span = np.log([given.near, given.far])
    assert (prediction.log_depths >= span[0] - 1e-4).all() and (prediction.log_depths <= span[1] + 1e-4).all()
    assert ((prediction.output.confidences >= 0) & (prediction.output.confidences <= 1)).all()


@pytest.mark.parametrize("name", HARD)
def test_hard_chunk_gives_finite_tokens_and_gradients(name):
    check_prediction(HARD[name](small.chunk()), small.warm_cache(), small.params())


@pytest.mark.parametrize("name", HARD_MEMORIES)
def test_hard_cache_gives_finite_tokens_and_gradients(name):
    cache, raw_gamma = HARD_MEMORIES[name]
    weights = small.params() | {"hpda": {"raw_gamma": jnp.float32(raw_gamma)}}  # softplus(1e6) is 1e6
    check_prediction(small.chunk(), cache(), weights)


def test_no_gradient_reaches_the_cache():
    _, (*_, remembered) = small.program(small.params(), small.warm_cache(), small.chunk())
    for gradient in remembered:
        np.testing.assert_array_equal(gradient, 0)


def test_every_stage_gets_a_gradient():
    _, (by_params, *_) = small.program(small.params(), small.warm_cache(), small.chunk())
    for stage in by_params.keys() - {"evidence"}:  # it is read from the cache, not from tokens
        assert max(float(jnp.abs(leaf).max()) for leaf in jax.tree.leaves(by_params[stage])) > 0, stage


def test_a_view_that_cannot_be_used_is_padding_and_counted():
    """One bad camera once wrote NaN into the observations of pivots that other views had confirmed."""
    images = small.chunk().images.at[1].set(small.chunk(5).images[0]).at[1, 0].set(jnp.nan)
    viewmats = small.chunk().viewmats.at[1].set(small.turned(0.3)[1])
    spoiled = replace(small.chunk(), images=images, viewmats=viewmats, Ks=small.chunk().Ks.at[1, 0, 0].set(-28.0))
    padded = replace(small.chunk(), valid=jnp.array([True, False, True]))
    (after, output), (wanted, expected) = (small.step(small.params(), small.warm_cache(), c) for c in (spoiled, padded))
    assert int(after.stats.num_unusable) == 1 and int(wanted.stats.num_unusable) == 0
    stats = replace(after.stats, num_unusable=wanted.stats.num_unusable)
    jax.tree.map(np.testing.assert_array_equal, replace(after, stats=stats), wanted)
    jax.tree.map(np.testing.assert_array_equal, output, expected)
    assert small.finite(small.program(small.params(), small.warm_cache(), spoiled)[1])
