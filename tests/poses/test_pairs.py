"""Pairs to match: neighbors at small and doubling distances, and images that look alike."""

import numpy as np

from ssplat_jax.poses.pairs import OVERLAP, alike_pairs, all_pairs, neighbor_pairs


def test_all_pairs_of_a_set():
    assert all_pairs(4) == [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]


def test_neighbors_are_matched_at_small_and_doubling_distances():
    gaps = {b - a for a, b in neighbor_pairs(100)}
    assert gaps == {*range(1, OVERLAP + 1), 16, 32, 64}
    pairs = neighbor_pairs(40)
    assert len(set(pairs)) == len(pairs) and all(0 <= a < b < 40 for a, b in pairs)
    assert {(39 - gap, 39) for gap in range(1, OVERLAP + 1)} <= set(pairs)


def test_images_of_the_same_place_are_alike():
    """Two walks past ten places: the partner of an image is that of the same place in the other walk."""
    rng = np.random.default_rng(0)
    places = [rng.uniform(0, 255, (30, 128)) for _ in range(10)]
    walks = [place + rng.normal(0, 8, place.shape) for _ in range(2) for place in places]
    descriptors = [walk.astype(np.float32) for walk in walks]
    assert alike_pairs(descriptors, 1) == [(i, i + 10) for i in range(10)]
    descriptors[13] = np.zeros((0, 128), np.float32)  # an image without features
    pairs = alike_pairs(descriptors, 1)
    assert all(13 not in pair for pair in pairs) and (2, 12) in pairs
    assert alike_pairs(descriptors[13:15], 5) == []


def test_every_image_has_as_many_partners_as_asked_for():
    rng = np.random.default_rng(1)
    pairs = alike_pairs([rng.uniform(0, 255, (20, 128)).astype(np.float32) for _ in range(12)], 3)
    counts = np.bincount(np.array(pairs).reshape(-1), minlength=12)
    assert (counts >= 3).all() and all(a < b for a, b in pairs) and len(set(pairs)) == len(pairs)
