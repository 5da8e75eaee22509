"""Tracks: keypoints that follow the image, pairs of cameras, and matches that are merged without contradictions."""

import numpy as np
from scipy.spatial.transform import Rotation

from ssplat_jax.poses.bundle_adjustment import alike_cameras, merged_tracks, sift_keypoints
from tests.poses.room_fixture import pictures, walk


def test_keypoints_follow_the_image():
    image = pictures(walk(1))[0].astype(np.float32) / 255
    first, shifted = sift_keypoints(image), sift_keypoints(np.roll(image, (8, 16), (0, 1)))
    apart = np.linalg.norm(first.pixels[:, None] + [16, 8] - shifted.pixels[None], axis=-1)
    is_inside = ((first.pixels > 30) & (first.pixels < np.array([160, 120]) - 40)).all(axis=1)
    assert is_inside.sum() > 20
    assert np.mean(apart.min(axis=1)[is_inside] < 0.1) > 0.9


def test_pairs_are_the_nearest_cameras_that_look_the_same_way():
    poses = np.tile(np.eye(4), (30, 1, 1))
    poses[:, 0, 3] = np.arange(30) * 0.1
    poses[29, :3, :3] = Rotation.from_euler("y", 90, degrees=True).as_matrix()
    pairs = alike_cameras(poses, depth=1.0)
    assert all(i < j for i, j in pairs) and len(set(pairs)) == len(pairs)
    assert {(10, 11), (10, 12), (10, 13), (10, 14)} <= set(pairs)
    assert (10, 20) not in pairs
    assert not any(29 in pair for pair in pairs)


def merged(matches, counts=(3, 3, 3)):
    views, keypoints, points = merged_tracks(counts, {pair: np.array(rows) for pair, rows in matches.items()})
    seen = np.stack([views, keypoints - 3 * views], axis=1).tolist()
    return {frozenset(tuple(seen[i]) for i in np.flatnonzero(points == p)) for p in set(points.tolist())}


def test_matches_are_chained_and_a_track_that_shows_a_camera_a_point_twice_is_left_out():
    chain = {(0, 1): [[0, 1]], (1, 2): [[1, 2]]}
    other = {(0, 2): [[2, 0]]}
    track, second = frozenset({(0, 0), (1, 1), (2, 2)}), frozenset({(0, 2), (2, 0)})
    assert merged(chain) == {track} and merged(chain | other) == {track, second}
    assert merged(chain | {(0, 2): [[1, 2], [2, 0]]}) == {second}
    assert merged({}) == set()
