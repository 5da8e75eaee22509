"""Bundle adjustment against dense float64 algebra, finite differences, and cameras whose poses are known."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ssplat_jax.poses import bundle_adjustment as module
from ssplat_jax.poses.bundle_adjustment import Observations, adjust, moved

K = np.array([[260.0, 0, 160], [0, 250, 120], [0, 0, 1]])
DEVIATIONS = (0.01, 0.01)
SCALES = (2.0, 1.0)


def scene(num_cameras=10, num_points=150, noise=0.0, false_share=0.0, seed=0):
    """Cameras on an arc before a cloud of points at depth 1, and exact or disturbed observations of them."""
    rng = np.random.default_rng(seed)
    viewmats = np.tile(np.eye(4), (num_cameras, 1, 1))
    for i, angle in enumerate(np.linspace(-0.4, 0.4, num_cameras)):
        turn = Rotation.from_euler("yx", [angle, 0.1 * np.sin(5 * angle)]).as_matrix()
        center = np.array([0.9 * np.sin(angle), 0.15 * np.cos(7 * angle), 1 - np.cos(angle)])
        viewmats[i, :3, :3], viewmats[i, :3, 3] = turn.T, -turn.T @ center
    points = np.array([0, 0, 1.0]) + rng.uniform(-0.3, 0.3, (num_points, 3))
    views, numbers = (a.ravel() for a in np.meshgrid(np.arange(num_cameras), np.arange(num_points), indexing="ij"))
    seen = np.einsum("nij,nj->ni", viewmats[views, :3, :3], points[numbers]) + viewmats[views, :3, 3]
    pixels = seen[:, :2] / seen[:, 2:] * K[[0, 1], [0, 1]] + K[:2, 2] + rng.normal(0, noise, (len(seen), 2))
    is_false = rng.uniform(size=len(seen)) < false_share
    pixels[is_false] += rng.uniform(-30, 30, (is_false.sum(), 2))
    return Observations(viewmats, np.tile(K, (num_cameras, 1, 1)), views, numbers, pixels), points


def disturbed(observations, degrees=0.5, shift=0.01, seed=1):
    """The observations from cameras whose poses are a little wrong."""
    rng = np.random.default_rng(seed)
    twists = rng.normal(size=(len(observations.Ks), 2, 3))
    twists /= np.linalg.norm(twists, axis=2, keepdims=True)
    twists = np.concatenate([np.radians(degrees) * twists[:, 0], shift * twists[:, 1]], axis=1)
    return dataclasses.replace(observations, viewmats=moved(observations.viewmats, twists))


def relative_turns(viewmats, exact):
    """Degrees by which the motion from each camera to the next differs from the exact one."""
    steps = [v[1:, :3, :3] @ v[:-1, :3, :3].transpose(0, 2, 1) for v in (viewmats, exact)]
    return np.degrees(Rotation.from_matrix(steps[0] @ steps[1].transpose(0, 2, 1)).magnitude())


def test_exact_observations_of_exact_poses_move_nothing():
    seen, points = scene()
    found = adjust(seen, SCALES, DEVIATIONS)
    assert np.abs(found.twists).max() < 1e-5
    # The weak pull to unit depth, which holds points of parallel rays, ends with the first guess.
    np.testing.assert_allclose(found.points, points, atol=1e-4)
    assert found.errors.max() < 1e-2


@pytest.mark.parametrize(("noise", "false_share", "largest"), [(0.0, 0.0, 0.05), (0.3, 0.0, 0.1), (0.3, 0.25, 0.1)])
def test_wrong_poses_are_put_right(noise, false_share, largest):
    exact, _ = scene(noise=noise, false_share=false_share)
    wrong = disturbed(exact)
    found = adjust(wrong, SCALES, DEVIATIONS)
    before = relative_turns(wrong.viewmats, exact.viewmats)
    after = relative_turns(moved(wrong.viewmats, found.twists), exact.viewmats)
    assert before.mean() > 0.4 and after.max() < largest
    fixed = adjust(wrong, SCALES, DEVIATIONS, is_fixed=True)
    assert not fixed.twists.any()
    assert np.median(fixed.errors) > 2 * np.median(found.errors) + 0.5


def test_poses_stay_around_the_given_ones():
    """The cameras together could turn and move as they like: the prior alone keeps them."""
    exact, _ = scene()
    wrong = disturbed(exact)
    found = adjust(wrong, SCALES, DEVIATIONS)
    after = moved(wrong.viewmats, found.twists)
    drift = Rotation.from_matrix(after[:, :3, :3] @ exact.viewmats[:, :3, :3].transpose(0, 2, 1)).mean()
    assert np.degrees(drift.magnitude()) < 0.5 / np.sqrt(len(exact.Ks)) * 1.5


def test_a_camera_without_observations_keeps_its_pose():
    exact, _ = scene()
    wrong = disturbed(exact)
    kept = wrong.views != 3
    parts = {name: getattr(wrong, name)[kept] for name in ("views", "points", "pixels")}
    found = adjust(dataclasses.replace(wrong, **parts), SCALES, DEVIATIONS)
    assert not found.twists[3].any() and found.twists[[2, 4]].all()


def test_steps_equal_those_of_the_dense_equations():
    seen = disturbed(scene(num_cameras=4, num_points=12, noise=1.0)[0])
    rng, damping = np.random.default_rng(2), 0.03
    twists, points = rng.normal(0, 0.01, (4, 6)), module._meeting_points(seen) + rng.normal(0, 0.02, (12, 3))
    prior = 1 / np.repeat(np.square(DEVIATIONS), 3)
    system = module._NormalEquations.at(seen, twists, points, 1.5, prior)
    normal = np.zeros((24 + 36, 24 + 36))
    for v in range(4):
        normal[6 * v : 6 * v + 6, 6 * v : 6 * v + 6] = system.of_cameras[v]
    for p in range(12):
        normal[24 + 3 * p : 27 + 3 * p, 24 + 3 * p : 27 + 3 * p] = system.of_points[p]
    for v, p, block in zip(seen.views, seen.points, system.between, strict=True):
        normal[6 * v : 6 * v + 6, 24 + 3 * p : 27 + 3 * p] = block
        normal[24 + 3 * p : 27 + 3 * p, 6 * v : 6 * v + 6] = block.T
    gradients = np.concatenate([system.camera_gradients.ravel(), system.point_gradients.ravel()])
    dense = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), -gradients)
    turn, shift = system.solve(damping, False)
    np.testing.assert_allclose(np.concatenate([turn.ravel(), shift.ravel()]), dense, rtol=1e-6, atol=1e-9)
    assert np.linalg.eigvalsh(normal).min() > 0


def test_slopes_equal_finite_differences_of_the_cost():
    seen = disturbed(scene(num_cameras=3, num_points=8, noise=1.0)[0])
    prior, scale = 1 / np.repeat(np.square(DEVIATIONS), 3), 1.5
    twists, points = np.zeros((3, 6)), module._meeting_points(seen)
    system = module._NormalEquations.at(seen, twists, points, scale, prior)
    cost = lambda t, x: module._cost(seen, t, x, scale, prior)  # noqa: E731
    for gradients, place in ((system.camera_gradients, 0), (system.point_gradients, 1)):
        for index in np.ndindex(gradients.shape):
            ends = []
            for sign in (-1, 1):
                moved_to = [twists.copy(), points.copy()]
                moved_to[place][index] += sign * 1e-6
                ends.append(cost(*moved_to))
            assert gradients[index] == pytest.approx((ends[1] - ends[0]) / 2e-6, rel=1e-4, abs=1e-4)


def test_points_of_parallel_rays_stay_finite():
    """Two cameras in one place: depths are unknown, and nothing becomes infinite."""
    seen, _ = scene(num_cameras=2)
    same = dataclasses.replace(seen, viewmats=np.tile(seen.viewmats[:1], (2, 1, 1)))
    same = dataclasses.replace(same, pixels=np.tile(seen.pixels[seen.views == 0], (2, 1)))
    found = adjust(same, SCALES, DEVIATIONS)
    assert np.isfinite(found.points).all() and np.abs(found.twists).max() < 1e-6


def test_points_behind_cameras_have_a_constant_cost_and_no_pull():
    seen, _ = scene(num_cameras=2, num_points=20)
    behind = seen.viewmats.copy()
    behind[1] = np.diag([-1.0, 1.0, -1.0, 1.0]) @ behind[1]  # looks away
    away = dataclasses.replace(seen, viewmats=behind)
    prior, points = np.ones(6), scene(num_cameras=2, num_points=20)[1]
    cost = module._cost(away, np.zeros((2, 6)), points, 1.0, prior)
    assert cost == pytest.approx(0.5 * 20 * module.HIDDEN_COST, abs=1e-6)
    assert not module._NormalEquations.at(away, np.zeros((2, 6)), points, 1.0, prior).camera_gradients[1].any()
