"""Two-view geometry and matching of descriptors."""

import numpy as np

from ssplat_jax.data.sparse_matches import epipolar_distances, match, motion_between, triangulate


def two_cameras(rng, num_points=50):
    angle = np.radians(5.0)
    R = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    t = np.array([0.3, -0.1, 0.05])
    points = np.concatenate([rng.uniform(-1, 1, (num_points, 2)), rng.uniform(2, 5, (num_points, 1))], -1)
    seen = points @ R.T + t
    return points, points / points[:, 2:], seen / seen[:, 2:], R, t


def test_motion_between_takes_points_from_one_camera_to_the_other():
    rng = np.random.default_rng(3)
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, :3, :3] = [np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in poses]  # far apart: no two axes are alike
    poses[:, :3, 3] = rng.normal(size=(2, 3))
    world = rng.normal(size=(20, 3))
    in_a, in_b = (np.linalg.solve(pose, np.c_[world, np.ones(20)].T).T[:, :3] for pose in poses)
    R, t = motion_between(*poses)
    np.testing.assert_allclose(in_a @ R.T + t, in_b, atol=1e-12)


def test_triangulation_inverts_projection():
    points, rays_a, rays_b, R, t = two_cameras(np.random.default_rng(0))
    inverse_depths, parallax = triangulate(rays_a, rays_b, R, t)
    np.testing.assert_allclose(1 / inverse_depths, points[:, 2], rtol=1e-10)
    to_a, to_b = points, points + R.T @ t
    cosine = (to_a * to_b).sum(-1) / np.linalg.norm(to_a, axis=-1) / np.linalg.norm(to_b, axis=-1)
    np.testing.assert_allclose(parallax, np.degrees(np.arccos(cosine)), rtol=1e-6)


def test_parallel_rays_meet_at_infinity_diverging_ones_behind():
    R, t, ray = np.eye(3), np.array([1.0, 0, 0]), np.array([[0.0, 0, 1]])
    inverse_depths, parallax = triangulate(ray, ray, R, t)
    assert inverse_depths[0] == 0 and parallax[0] == 0
    inverse_depths, parallax = triangulate(ray, np.array([[-0.1, 0, 1]]), R, t)
    np.testing.assert_allclose(inverse_depths, -0.1, rtol=1e-12)
    assert parallax[0] < 0


def test_only_true_matches_lie_on_their_epipolar_lines():
    _, rays_a, rays_b, R, t = two_cameras(np.random.default_rng(1))
    distances = epipolar_distances(rays_a, rays_b, R, t)
    assert np.diag(distances).max() < 1e-12
    assert np.median(distances) > 0.05


def test_matching_is_mutual_unambiguous_and_restricted():
    rng = np.random.default_rng(2)
    a = rng.random((40, 256)) < 0.5
    order = rng.permutation(40)
    b = a[order] ^ (rng.random((40, 256)) < 0.1)
    everywhere = np.ones((40, 40), bool)
    idx_a, idx_b = match(a, b, everywhere)
    assert len(idx_a) == 40 and (order[idx_b] == idx_a).all()
    forbidden = everywhere.copy()
    forbidden[:, :10] = False
    assert match(a, b, forbidden)[1].min() >= 10
    doubled = np.concatenate([b, b[:1]])
    assert 0 not in match(a, doubled, np.ones((40, 41), bool))[1]  # ambiguous: two equal candidates
