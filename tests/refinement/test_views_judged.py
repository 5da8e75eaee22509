"""Laws of what refinement thinks of its key views: which it can learn from, and what may be wrong with them."""

import dataclasses
import functools

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.core.pytree import replace
from ssplat_jax.evaluation.psnr_ssim import psnr
from ssplat_jax.rasterizer import Effects, render
from ssplat_jax.refinement import KeyViews, only_usable, refine
from ssplat_jax.refinement.usable_views import contradicting, sound_views

WIDTH, HEIGHT, FOCAL, NUM_VIEWS, MAX_PAIRS = 48, 32, 40.0, 8, 1 << 14
COLUMNS, ROWS = 40, 28


@functools.cache
def wall() -> Gaussians:
    """A wavy wall of smooth colors that fills every view."""
    random = np.random.default_rng(3)
    x, y = np.meshgrid(np.linspace(-2.4, 2.4, COLUMNS), np.linspace(-1.7, 1.7, ROWS))
    z = 3.0 + 0.4 * np.sin(2 * x) * np.cos(3 * y)
    waves = sum(
        random.uniform(0.05, 0.16, 3) * np.sin(np.add.outer(a * x + b * y, random.uniform(0, 6, 3)))
        for a, b in random.uniform(-6, 6, (8, 2))
    )
    num = x.size
    return Gaussians.from_rgb(
        means=jnp.asarray(np.stack([x, y, z], -1).reshape(num, 3), jnp.float32),
        quats=jnp.tile(jnp.array([1.0, 0, 0, 0]), (num, 1)),
        scales=jnp.full((num, 3), 0.1),
        opacities=jnp.full(num, 0.95),
        colors=jnp.asarray(np.clip(0.5 + np.reshape(waves, (num, 3)), 0.05, 0.95), jnp.float32),
    )


def cameras(shifts) -> Camera:
    """Cameras beside each other that look along +z."""
    viewmats = np.tile(np.eye(4, dtype=np.float32), (len(shifts), 1, 1))
    viewmats[:, 0, 3] = shifts
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], np.float32)
    Ks = np.tile(K, (len(shifts), 1, 1))
    return Camera(viewmats=jnp.asarray(viewmats), Ks=jnp.asarray(Ks), width=WIDTH, height=HEIGHT)


@functools.cache
def photographs():
    """The wall as the cameras of `views` see it."""
    color = render(wall(), views_cameras(), effects=Effects(outputs=("color",)), max_pairs=MAX_PAIRS).color
    return color


def views_cameras() -> Camera:
    return cameras(np.linspace(-0.2, 0.2, NUM_VIEWS))


def views() -> KeyViews:
    return KeyViews.of(views_cameras(), photographs())


def doubtful() -> Gaussians:
    """The wall with colors that are a little wrong."""
    noise = jnp.asarray(np.random.default_rng(1).normal(size=wall().sh.shape), jnp.float32)
    return replace(wall(), sh=wall().sh + 0.15 * noise)


def turned(views: KeyViews, slot: int, degrees: float) -> KeyViews:
    """`views` with one camera turned by an angle."""
    axis = np.random.default_rng(7).normal(size=3)
    turn = Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis)).as_matrix()
    viewmat = jnp.asarray(turn, jnp.float32) @ views.viewmats[slot, :3]
    return replace(views, viewmats=views.viewmats.at[slot, :3].set(viewmat))


def adversaries() -> dict[str, KeyViews]:
    good = views()
    return {
        "black": replace(good, images=good.images.at[2].set(0)),
        "NaN exposure": replace(good, exposures=good.exposures.at[2].set(jnp.nan)),
        "no exposure": replace(good, exposures=good.exposures.at[2].set(0.0)),
        "broken camera": replace(good, viewmats=good.viewmats.at[2, 0, 3].set(jnp.inf)),
        "wrong pose": turned(good, 2, 5.0),
    }


@pytest.mark.parametrize("name", adversaries())
def test_a_view_that_cannot_be_learned_from_is_left_out_and_no_other(name):
    kept = np.asarray(only_usable(doubtful(), adversaries()[name], MAX_PAIRS).valid)
    assert np.flatnonzero(~kept).tolist() == [2]


def test_good_views_stay_and_so_do_duplicates():
    good = views()
    twice = replace(
        good, images=good.images.at[1].set(good.images[0]), viewmats=good.viewmats.at[1].set(good.viewmats[0])
    )
    for given in (good, twice):
        assert np.asarray(only_usable(doubtful(), given, MAX_PAIRS).valid).all()


def test_a_sound_view_has_a_positive_exposure_and_a_finite_camera():
    given = adversaries()
    unsound = {name: np.flatnonzero(~sound_views(views)).tolist() for name, views in given.items()}
    broken = ("NaN exposure", "no exposure", "broken camera")
    assert unsound == {name: [2] if name in broken else [] for name in given}


def test_no_view_left_is_an_error_that_says_so():
    broken = replace(views(), exposures=jnp.full((NUM_VIEWS, 3), jnp.nan))
    with pytest.raises(InputError, match="at least one view with a finite camera"):
        only_usable(doubtful(), broken, MAX_PAIRS)


def test_errors_are_judged_by_their_median():
    usual = np.array([1.0, 1.1, 0.9, 1.0, 1.05, 0.95, 1.0, 1.0])
    assert contradicting(usual).size == 0
    for k, large in ((3, 2.1), (5, 9.0)):
        assert contradicting(np.where(np.arange(8) == k, large, usual)).tolist() == [k]
    assert contradicting(np.where(np.arange(8) == 3, 1.9, usual)).size == 0
    assert contradicting(np.where(np.arange(8) < 3, [9, 8, 7, 0, 0, 0, 0, 0], usual)).tolist() == [0, 1]  # a quarter
    assert contradicting(np.array([1.0, 1.0, 50.0])).size == 0  # too few to judge
    assert contradicting(np.where(np.arange(8) == 3, np.nan, usual)).size == 0


@pytest.mark.parametrize("name", ["black", "NaN exposure", "wrong pose", "duplicate", "one view"])
@pytest.mark.slow
def test_adversarial_views_cost_no_more_than_a_third_of_a_decibel(name):
    good = views()
    given = adversaries() | {
        "duplicate": taken(good, [0, 0, 0, 0, 0, 0, 0, 3]),
        "one view": replace(good, exposures=good.exposures.at[jnp.arange(NUM_VIEWS) != 4].set(jnp.nan)),
    }
    chosen = given[name]
    unseen = cameras([0.07])
    truth = np.asarray(render(wall(), unseen, max_pairs=MAX_PAIRS).color)[0]
    score = lambda g: psnr(np.asarray(render(g, unseen, max_pairs=MAX_PAIRS).color)[0], truth)  # noqa: E731
    camera = Camera(viewmats=chosen.viewmats, Ks=chosen.Ks, width=WIDTH, height=HEIGHT)
    images = chosen.images.astype(jnp.float32) / 255
    refined, report = refine(doubtful(), camera, images, steps=16, exposures=chosen.exposures)
    assert all(np.isfinite(np.asarray(x)).all() for x in vars(refined).values())
    assert report.num_skipped == 0
    assert score(refined) > score(doubtful()) - 0.3


def taken(views: KeyViews, slots: list[int]) -> KeyViews:
    index = jnp.array(slots)
    return KeyViews(*(getattr(views, field.name)[index] for field in dataclasses.fields(views)))
