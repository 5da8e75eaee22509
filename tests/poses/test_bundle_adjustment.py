"""Bundle adjustment of cameras whose poses are known."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

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
    twists = np.random.default_rng(seed).normal(size=(len(observations.Ks), 2, 3))
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
    assert np.median(found.errors_before) > 2 * np.median(found.errors) + 0.5


def test_poses_stay_around_the_given_ones():
    """The cameras together could turn and move as they like: the prior alone keeps them."""
    exact, _ = scene()
    wrong = disturbed(exact)
    after = moved(wrong.viewmats, adjust(wrong, SCALES, DEVIATIONS).twists)
    drift = Rotation.from_matrix(after[:, :3, :3] @ exact.viewmats[:, :3, :3].transpose(0, 2, 1)).mean()
    assert np.degrees(drift.magnitude()) < 0.5 / np.sqrt(len(exact.Ks)) * 1.5


@pytest.mark.parametrize("looks_away", [False, True])
def test_a_camera_that_sees_no_point_keeps_its_pose(looks_away):
    """Points behind a camera do not pull it."""
    exact, _ = scene()
    wrong = disturbed(exact)
    if looks_away:
        wrong.viewmats[3] = np.diag([-1.0, 1.0, -1.0, 1.0]) @ wrong.viewmats[3]
    else:
        parts = {name: getattr(wrong, name)[wrong.views != 3] for name in ("views", "points", "pixels")}
        wrong = dataclasses.replace(wrong, **parts)
    found = adjust(wrong, SCALES, DEVIATIONS)
    assert np.abs(found.twists[3]).max() < 1e-9 and found.twists[[2, 4]].all()


def test_points_of_parallel_rays_stay_finite():
    """Two cameras in one place: depths are unknown, and nothing becomes infinite."""
    seen, _ = scene(num_cameras=2)
    same = dataclasses.replace(seen, viewmats=np.tile(seen.viewmats[:1], (2, 1, 1)))
    same = dataclasses.replace(same, pixels=np.tile(seen.pixels[seen.views == 0], (2, 1)))
    found = adjust(same, SCALES, DEVIATIONS)
    assert np.isfinite(found.points).all() and np.abs(found.twists).max() < 1e-6
