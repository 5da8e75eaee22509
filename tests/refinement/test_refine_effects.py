"""Laws of the effects of refinement: poses, focal length, exposures and white balance of key views."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import mean_color
from ssplat_jax.core.pytree import replace
from ssplat_jax.evaluation.psnr_ssim import psnr
from ssplat_jax.rasterizer import render
from ssplat_jax.refinement import RefineConfig, RefineEffects, init_refinement, refine, refine_step, revised_key_views
from ssplat_jax.refinement.view_loss import view_loss
from ssplat_jax.refinement.view_revision import (
    ViewRevision,
    bounded_views,
    moved_viewmat,
    revised_view,
    step_view_state,
)
from tests.refinement.test_refine import (
    CONFIG,
    MAX_PAIRS,
    NUM_VIEWS,
    cameras,
    doubtful,
    key_views,
    photographs,
    scene,
    step,
)

ALL = RefineEffects(poses=True, focal=True, exposures=True, white_balance=True)


def with_effects(**effects) -> RefineConfig:
    return dataclasses.replace(CONFIG, effects=RefineEffects(**effects))


def steps(config: RefineConfig, views, num: int, gaussians=None):
    state = init_refinement(scene() if gaussians is None else gaussians, views, config)
    for _ in range(num):
        state, _ = step(state, views, config=config)
    return state


def jaxpr_of(config: RefineConfig, views, state) -> str:
    body = lambda s, r: refine_step(s, views, r, config=config, max_pairs=MAX_PAIRS)  # noqa: E731
    return str(jax.make_jaxpr(body)(state, jnp.float32(1)))


def test_effects_that_are_off_leave_no_operation_behind():
    views = key_views()
    plain = jaxpr_of(CONFIG, views, init_refinement(scene()))
    off = dataclasses.replace(CONFIG, effects=RefineEffects(pose_rate=1.0, max_rotation=9.0))
    assert jaxpr_of(off, views, init_refinement(scene(), views, off)) == plain
    for name in ("poses", "focal", "exposures", "white_balance"):
        on = with_effects(**{name: True})
        assert len(jaxpr_of(on, views, init_refinement(scene(), views, on))) > len(plain)


def test_a_motion_is_the_rotation_and_shift_in_float64():
    from scipy.spatial.transform import Rotation

    twist = np.array([0.01, -0.02, 0.015, 0.1, -0.2, 0.05])
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = Rotation.from_euler("xyz", [0.3, 1.0, -0.4]).as_matrix(), [0.5, -1, 2]
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = Rotation.from_rotvec(twist[:3]).as_matrix(), 3.0 * twist[3:]
    moved = moved_viewmat(jnp.asarray(viewmat, jnp.float32), jnp.asarray(twist, jnp.float32), jnp.float32(3.0))
    np.testing.assert_allclose(np.asarray(moved), motion @ viewmat, atol=5e-6)


def test_gradient_of_a_pose_is_the_central_difference():
    config, views = with_effects(poses=True), key_views()
    state = init_refinement(doubtful(), views, config)
    of_views = state.views
    assert of_views is not None

    @jax.jit
    def loss(poses):
        moved = ViewRevision(poses=poses, log_focal=None, log_exposures=None)
        seen = revised_view(of_views, moved, views, jnp.int32(1))
        return view_loss(state.start, mean_color(state.start), seen, jnp.int32(1), config, MAX_PAIRS)[0]

    poses, width = jnp.zeros((NUM_VIEWS, 6)), 2e-3
    slopes = jax.grad(loss)(poses)[1]
    for entry in range(6):
        ends = [float(loss(poses.at[1, entry].add(sign * width))) for sign in (1, -1)]
        assert float(slopes[entry]) == pytest.approx((ends[0] - ends[1]) / (2 * width), rel=0.15, abs=3e-3), entry


def wrong_poses(views, degrees=0.5, of_depth=0.01):
    """`views` with every pose but the first turned and shifted; the depth of the scene is about 3."""
    random = np.random.default_rng(5)
    turn, shift = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in random.normal(size=(2, NUM_VIEWS, 3)))
    twists = jnp.asarray(np.concatenate([np.radians(degrees) * turn, of_depth * shift], 1), jnp.float32)
    moved = [moved_viewmat(v, t, jnp.float32(3.0)) for v, t in zip(views.viewmats[1:], twists[1:], strict=True)]
    return replace(views, viewmats=jnp.stack([views.viewmats[0], *moved]))


def test_poses_find_back_and_the_first_stays():
    given, true = wrong_poses(key_views()), key_views()
    config = dataclasses.replace(with_effects(poses=True), mean_rate=0.0, log_scale_rate=0.0, quat_rate=0.0)
    config = dataclasses.replace(config, logit_opacity_rate=0.0, color_rate=0.0)
    found = revised_key_views(steps(config, given, 80).views, given)
    error = lambda v: float(jnp.sqrt(jnp.mean((v.viewmats - true.viewmats) ** 2)))  # noqa: E731
    assert error(found) < 0.35 * error(given)
    np.testing.assert_array_equal(np.asarray(found.viewmats[0]), np.asarray(given.viewmats[0]))


@pytest.mark.slow
def test_pose_refinement_wins_back_two_thirds_of_the_loss():
    """On a view never shown; poses off by 0.5 degrees and 1 % of the depth."""
    unseen = cameras(shifts=(0.08,))
    truth = np.asarray(render(scene(), unseen).color)[0]
    scores = {}
    for name, views, effects in (
        ("exact", key_views(), {}),
        ("wrong", wrong_poses(key_views()), {}),
        ("refined", wrong_poses(key_views()), {"poses": True}),
    ):
        camera = replace(cameras(), viewmats=views.viewmats)
        revised, _ = refine(doubtful(), camera, photographs(), steps=160, config=with_effects(**effects))
        scores[name] = psnr(np.asarray(render(revised, unseen).color)[0], truth)
    lost = scores["exact"] - scores["wrong"]
    assert lost > 0.5
    assert scores["refined"] - scores["wrong"] > 2 / 3 * lost, scores


def test_a_focal_length_finds_back():
    true = key_views()
    given = replace(true, Ks=true.Ks.at[:, [0, 1], [0, 1]].multiply(1.02))
    config = dataclasses.replace(
        with_effects(focal=True),
        mean_rate=0.0,
        log_scale_rate=0.0,
        quat_rate=0.0,
        logit_opacity_rate=0.0,
        color_rate=0.0,
    )
    found = revised_key_views(steps(config, given, 60).views, given)
    np.testing.assert_allclose(np.asarray(found.Ks[:, 0, 0]), np.asarray(true.Ks[:, 0, 0]), rtol=0.004)
    np.testing.assert_array_equal(np.asarray(found.Ks[:, :, 2]), np.asarray(given.Ks[:, :, 2]))


@pytest.mark.parametrize("tint", [False, True])
def test_exposures_find_back_with_their_mean_kept(tint):
    factors = np.array([[1.2] * 3, [1 / 1.2] * 3, [1.1] * 3, [1 / 1.1] * 3])
    if tint:
        factors = factors * np.array([[1.1, 1, 1 / 1.1], [1 / 1.1, 1, 1.1], [1, 1.1, 1 / 1.1], [1, 1 / 1.1, 1.1]])
    images = jnp.clip(photographs() * 0.6 * jnp.asarray(factors, jnp.float32)[:, None, None], 0, 1)
    views = key_views(images, exposures=jnp.full((NUM_VIEWS, 3), 0.6))
    config = dataclasses.replace(
        with_effects(exposures=True, white_balance=tint), mean_rate=0.0, color_rate=0.0, logit_opacity_rate=0.0
    )
    found = revised_key_views(steps(config, views, 80).views, views)
    np.testing.assert_allclose(np.asarray(found.exposures) / 0.6, factors, rtol=0.03)
    np.testing.assert_allclose(np.prod(np.asarray(found.exposures) / 0.6, axis=0), 1.0, rtol=1e-4)


def test_white_balance_alone_keeps_every_exposure():
    images = jnp.clip(photographs() * jnp.array([0.9, 0.8, 0.7]), 0, 1)
    views = key_views(images)
    state = steps(with_effects(white_balance=True), views, 6)
    assert state.views is not None
    change = np.asarray(state.views.revision.log_exposures)
    assert np.abs(change).max() > 0
    np.testing.assert_allclose(change.sum(axis=1), 0, atol=1e-6)


def test_a_constant_gradient_moves_the_focal_length_by_its_rate_at_every_step():
    """Adam without a wrong correction of its bias, whichever view a step shows."""
    views, effects = key_views(), RefineEffects(focal=True, max_log_focal=1.0)
    state = init_refinement(scene(), views, dataclasses.replace(CONFIG, effects=effects)).views
    slope = ViewRevision(poses=None, log_focal=jnp.float32(0.5), log_exposures=None)
    for i in range(3 * NUM_VIEWS):
        shown = jnp.array([i % NUM_VIEWS, (i + 1) % NUM_VIEWS])
        state = step_view_state(state, slope, shown, views.valid, jnp.float32(1), effects)
        assert float(state.revision.log_focal) == pytest.approx(-(i + 1) * effects.focal_rate, rel=1e-3)


def test_no_view_leaves_its_trust_region():
    huge = ViewRevision(
        poses=jnp.full((NUM_VIEWS, 6), 7.0), log_focal=jnp.float32(-3), log_exposures=jnp.eye(NUM_VIEWS)[:, :3] * 9
    )
    kept = bounded_views(huge, jnp.ones(NUM_VIEWS, bool), ALL)
    poses = np.asarray(kept.poses)
    assert np.linalg.norm(poses[:, :3], axis=1) == pytest.approx(ALL.max_rotation)
    assert np.linalg.norm(poses[:, 3:], axis=1) == pytest.approx(ALL.max_translation)
    assert kept.log_focal is not None and float(kept.log_focal) == pytest.approx(-ALL.max_log_focal)
    assert np.abs(np.asarray(kept.log_exposures)).max() <= ALL.max_log_exposure


def test_a_step_that_is_not_finite_moves_no_view():
    views = key_views(exposures=jnp.full((NUM_VIEWS, 3), jnp.nan))
    config = dataclasses.replace(CONFIG, effects=ALL)
    state, fresh = steps(config, views, 2), init_refinement(scene(), views, config)
    for new, old in zip(jax.tree.leaves(state.views), jax.tree.leaves(fresh.views), strict=True):
        np.testing.assert_array_equal(np.asarray(new), np.asarray(old))


def test_effects_without_key_views_and_bad_bounds_are_refused():
    with pytest.raises(InputError, match="effects poses need the key views, got none"):
        init_refinement(scene(), config=with_effects(poses=True))
    with pytest.raises(InputError, match=r"pose_rate must be finite and not negative, got -1\.0"):
        RefineEffects(pose_rate=-1.0)
