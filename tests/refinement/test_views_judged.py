"""Laws of what refinement thinks of its key views: which it can learn from, and what may be wrong with them."""

import dataclasses
import functools

import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.core.pytree import replace
from ssplat_jax.evaluation.psnr_ssim import psnr
from ssplat_jax.rasterizer import Effects, render
from ssplat_jax.refinement import KeyViews, RefineConfig, RefineEffects, only_usable, refine, refine_effects_for
from ssplat_jax.refinement import choose_effects as module
from ssplat_jax.refinement.choose_effects import choose_effects, effects_by_name, with_effects
from ssplat_jax.refinement.usable_views import contradicting, sound_views
from ssplat_jax.refinement.view_residuals import _columns, view_residuals
from ssplat_jax.refinement.view_revision import moved_viewmat

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
    assert color is not None
    return color


def views_cameras() -> Camera:
    return cameras(np.linspace(-0.2, 0.2, NUM_VIEWS))


def views() -> KeyViews:
    return KeyViews.of(views_cameras(), photographs())


def doubtful() -> Gaussians:
    """The wall with colors that are a little wrong."""
    noise = jnp.asarray(np.random.default_rng(1).normal(size=wall().sh.shape), jnp.float32)
    return replace(wall(), sh=wall().sh + 0.15 * noise)


def turned(views: KeyViews, slots, degrees: float, of_depth: float = 0.0) -> KeyViews:
    """`views` with some poses turned by an angle and shifted by a share of the depth, each its own way."""
    random, viewmats = np.random.default_rng(7), views.viewmats
    for slot in slots:
        turn, shift = (v / np.linalg.norm(v) for v in random.normal(size=(2, 3)))
        twist = jnp.asarray(np.concatenate([np.radians(degrees) * turn, of_depth * shift]), jnp.float32)
        viewmats = viewmats.at[slot].set(moved_viewmat(viewmats[slot], twist, jnp.float32(3.0)))
    return replace(views, viewmats=viewmats)


def adversaries() -> dict[str, KeyViews]:
    good = views()
    return {
        "black": replace(good, images=good.images.at[2].set(0)),
        "NaN exposure": replace(good, exposures=good.exposures.at[2].set(jnp.nan)),
        "no exposure": replace(good, exposures=good.exposures.at[2].set(0.0)),
        "broken camera": replace(good, viewmats=good.viewmats.at[2, 0, 3].set(jnp.inf)),
        "wrong pose": turned(good, [2], 5.0),
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


def test_columns_are_the_derivatives_of_projected_points():
    """Flow of a twist and of the focal length against central differences of projecting the moved points, float64."""
    random = np.random.default_rng(2)
    h, w, depth = 6, 8, 2.5
    K = np.array([[30.0, 0, 4.2], [0, 28.0, 2.9], [0, 0, 1]])
    z = random.uniform(1.5, 4.0, (h, w))
    ramp = np.zeros((h, w, 3))
    ramp[..., 0], ramp[..., 1] = np.arange(w)[None, :], np.arange(h)[:, None]  # gradients 1 along x and along y
    columns = _columns(ramp, z, K, depth)
    pixels = np.stack(np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5), -1)
    rays = np.concatenate([(pixels - K[:2, 2]) / np.array([K[0, 0], K[1, 1]]), np.ones((h, w, 1))], -1)
    points = rays * z[..., None]

    def project(twist, log_focal):
        moved = points + np.cross(twist[:3], points) + depth * twist[3:]
        focal = np.array([K[0, 0], K[1, 1]]) * np.exp(log_focal)
        return moved[..., :2] / moved[..., 2:] * focal + K[:2, 2]

    for k in range(7):
        step = np.zeros(7)
        step[k] = 1e-6
        flow = (project(step[:6], step[6]) - project(-step[:6], -step[6])) / 2e-6
        np.testing.assert_allclose(-columns[..., :2, 3 + k], flow, rtol=1e-6, atol=1e-6)
        np.testing.assert_array_equal(columns[..., 2, 3 + k], 0.0)
    np.testing.assert_array_equal(columns[..., :3], ramp[..., None] * np.eye(3))


def test_fits_find_what_was_changed():
    good = views()
    small = turned(good, range(1, NUM_VIEWS), 0.3)
    fits = view_residuals(wall(), small)
    angles = np.degrees(np.linalg.norm(fits.twists[1:, :3], axis=1))
    assert 0.2 < np.median(angles) < 0.4 and np.median(fits.explained[1:, 1]) > 0.5
    longer = replace(good, Ks=good.Ks.at[:, :2, :2].multiply(1.02))
    assert np.median(view_residuals(wall(), longer).log_focals) == pytest.approx(-np.log(1.02), abs=0.006)
    darker = replace(good, exposures=good.exposures.at[3].set(jnp.array([1.1, 1.0, 0.9])))
    gains = view_residuals(wall(), darker).log_gains
    np.testing.assert_allclose(gains[3], -np.log([1.1, 1.0, 0.9]), atol=0.02)
    np.testing.assert_allclose(np.delete(gains, 3, axis=0), 0.0, atol=0.01)


CHANGES = {
    "nothing": lambda v: v,
    "poses": lambda v: turned(v, range(1, NUM_VIEWS), 0.5, 0.01),
    "focal": lambda v: replace(v, Ks=v.Ks.at[:, :2, :2].multiply(1.03)),
    "exposures": lambda v: replace(v, exposures=v.exposures * jnp.linspace(0.8, 1.2, NUM_VIEWS)[:, None]),
    "white_balance": lambda v: replace(
        v, exposures=v.exposures * jnp.exp(jnp.outer(jnp.linspace(-0.1, 0.1, NUM_VIEWS), jnp.array([1.0, 0.0, -1.0])))
    ),
}


@pytest.mark.parametrize("name", CHANGES)
def test_the_effects_asked_for_are_those_that_were_changed(name):
    choice = refine_effects_for(doubtful(), CHANGES[name](views()))
    wanted = () if name == "nothing" else (name,)
    assert choice.effects.names == wanted, choice.reasons
    assert len(choice.reasons) == 4


def test_too_few_fits_ask_for_nothing():
    alone = replace(views(), valid=jnp.arange(NUM_VIEWS) < 2)
    choice = choose_effects(view_residuals(doubtful(), turned(alone, [1], 1.0)))
    assert not choice.effects.any and "got 2" in choice.reasons[0]


@pytest.mark.parametrize("names", [("auto",), ("poses", "focal")])
def test_adjusted_poses_stay_whoever_asks(names, monkeypatch):
    both = module.EffectsChoice(RefineEffects(poses=True, focal=True), ("poses on: far off", "focal on: far off"))
    monkeypatch.setattr(module, "refine_effects_for", lambda *given: both)
    choice = effects_by_name(names, doubtful(), views(), poses_stay=True)
    assert choice.effects == RefineEffects(focal=True)
    said = [reason for reason in choice.reasons if reason.startswith("poses")]
    assert said == (["poses stay: they were adjusted before the stream"] if "poses" in names else [])
    assert effects_by_name(names, doubtful(), views()).effects.poses


def test_effects_by_name_are_taken_or_refused():
    choice = effects_by_name(("focal", "poses"), doubtful(), views())
    assert choice.effects == RefineEffects(poses=True, focal=True)
    config = with_effects(RefineConfig(effects=RefineEffects(exposures=True, pose_rate=0.1)), choice)
    assert config.effects == RefineEffects(poses=True, focal=True, exposures=True, pose_rate=0.1)
    for bad in (("pose",), ("auto", "focal")):
        with pytest.raises(InputError, match="wanted effects among auto"):
            effects_by_name(bad, doubtful(), views())
