"""Laws of key views: the order in which steps take them, and which of them a scene can learn from."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.core.pytree import replace
from ssplat_jax.rasterizer import render
from ssplat_jax.refinement import KeyViews
from ssplat_jax.refinement.compared_views import contradicting, next_view, only_usable
from tests.rasterizer.scenes import balls
from tests.refinement.test_refine import cameras

NUM_VIEWS, MAX_PAIRS = 8, 1 << 14


@functools.cache
def wall() -> Gaussians:
    """A wavy wall of smooth colors that fills every view."""
    random = np.random.default_rng(3)
    x, y = np.meshgrid(np.linspace(-2.4, 2.4, 40), np.linspace(-1.7, 1.7, 28))
    z = 3.0 + 0.4 * np.sin(2 * x) * np.cos(3 * y)
    waves = sum(
        random.uniform(0.05, 0.16, 3) * np.sin(np.add.outer(a * x + b * y, random.uniform(0, 6, 3)))
        for a, b in random.uniform(-6, 6, (8, 2))
    )
    colors = np.clip(0.5 + np.reshape(waves, (x.size, 3)), 0.05, 0.95)
    return balls(np.stack([x, y, z], axis=-1).reshape(-1, 3), 0.1, 0.95, colors)


@functools.cache
def views() -> KeyViews:
    """The wall from eight places."""
    given = cameras(np.linspace(-0.2, 0.2, NUM_VIEWS), 40.0, 48, 32)
    return KeyViews.of(given, render(wall(), given, max_pairs=MAX_PAIRS).color)


def doubtful() -> Gaussians:
    """The wall with colors that are a little wrong."""
    noise = jnp.asarray(np.random.default_rng(1).normal(size=wall().sh.shape), jnp.float32)
    return replace(wall(), sh=wall().sh + 0.15 * noise)


def turned(given: KeyViews, slot: int, degrees: float) -> KeyViews:
    """`given` with one camera turned by an angle."""
    axis = np.random.default_rng(7).normal(size=3)
    turn = Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis)).as_matrix()
    viewmat = jnp.asarray(turn, jnp.float32) @ given.viewmats[slot, :3]
    return replace(given, viewmats=given.viewmats.at[slot, :3].set(viewmat))


ADVERSARIES = {
    "black": lambda v: replace(v, images=v.images.at[2].set(0)),
    "NaN exposure": lambda v: replace(v, exposures=v.exposures.at[2].set(jnp.nan)),
    "no exposure": lambda v: replace(v, exposures=v.exposures.at[2].set(0.0)),
    "broken camera": lambda v: replace(v, viewmats=v.viewmats.at[2, 0, 3].set(jnp.inf)),
    "wrong pose": lambda v: turned(v, 2, 5.0),
}


@pytest.mark.parametrize("name", ADVERSARIES)
def test_a_view_that_cannot_be_learned_from_is_left_out_and_no_other(name):
    kept = np.asarray(only_usable(doubtful(), ADVERSARIES[name](views()), MAX_PAIRS).valid)
    assert np.flatnonzero(~kept).tolist() == [2]


def test_good_views_stay_and_so_do_duplicates():
    good = views()
    copied = {name: getattr(good, name).at[1].set(getattr(good, name)[0]) for name in ("images", "viewmats")}
    for given in (good, replace(good, **copied)):
        assert np.asarray(only_usable(doubtful(), given, MAX_PAIRS).valid).all()


def test_no_view_left_is_an_error_that_says_so():
    broken = replace(views(), exposures=jnp.full((NUM_VIEWS, 3), jnp.nan))
    with pytest.raises(InputError, match="at least one view with a finite camera"):
        only_usable(doubtful(), broken, MAX_PAIRS)


def test_errors_are_compared_with_their_median():
    usual = np.array([1.0, 1.1, 0.9, 1.0, 1.05, 0.95, 1.0, 1.0])
    assert contradicting(usual).size == 0
    for k, large in ((3, 2.1), (5, 9.0)):
        assert contradicting(np.where(np.arange(8) == k, large, usual)).tolist() == [k]
    assert contradicting(np.where(np.arange(8) == 3, 1.9, usual)).size == 0
    assert contradicting(np.where(np.arange(8) < 3, [9, 8, 7, 0, 0, 0, 0, 0], usual)).tolist() == [0, 1]  # a quarter
    assert contradicting(np.array([1.0, 1.0, 50.0])).size == 0  # too few
    assert contradicting(np.where(np.arange(8) == 3, np.nan, usual)).size == 0


def test_every_round_shows_every_valid_view_once():
    valid = jnp.array([True, False, True, True, False])
    order = [int(next_view(jnp.int32(i), valid, seed=0)) for i in range(30)]
    rounds = [order[i : i + 3] for i in range(0, 30, 3)]
    assert all(sorted(part) == [0, 2, 3] for part in rounds)
    assert len({tuple(part) for part in rounds}) > 1


def test_any_few_views_in_a_row_lie_evenly_in_the_stream():
    """Within a round, 16 views of 64 leave gaps of at most 9, where 4 would be exactly even."""
    order = np.array([int(next_view(jnp.int32(i), jnp.ones(64, bool), seed=3)) for i in range(64)])
    assert max(np.diff(np.sort(order[i : i + 16]), prepend=-1, append=64).max() for i in range(49)) <= 9
