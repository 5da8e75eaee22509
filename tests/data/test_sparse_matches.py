"""Two-view geometry and matching of descriptors."""

import numpy as np

from ssplat_jax.data.sparse_matches import match, triangulate
from tests.core.test_rotations import rodrigues


def test_triangulation_inverts_projection():
    rng, R, t = np.random.default_rng(0), rodrigues([0, 1, 0], np.radians(5.0)), np.array([0.3, -0.1, 0.05])
    points = np.concatenate([rng.uniform(-1, 1, (50, 2)), rng.uniform(2, 5, (50, 1))], -1)
    seen = points @ R.T + t
    inverse_depths, parallax = triangulate(points / points[:, 2:], seen / seen[:, 2:], R, t)
    np.testing.assert_allclose(1 / inverse_depths, points[:, 2], rtol=1e-10)
    to_b = points + R.T @ t
    cosine = (points * to_b).sum(-1) / np.linalg.norm(points, axis=-1) / np.linalg.norm(to_b, axis=-1)
    np.testing.assert_allclose(parallax, np.degrees(np.arccos(cosine)), rtol=1e-6)


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
