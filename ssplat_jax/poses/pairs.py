"""Pairs of images to match: all of a small set; neighbors in time; and images that look alike, which close loops.

Alike means: similar vectors of locally aggregated descriptors (VLAD, Jégou et al., CVPR 2010) over a vocabulary that is
learned from the images themselves, so nothing has to be downloaded.
"""

import itertools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32

MAX_EXHAUSTIVE = 100  # images of which all pairs are matched
OVERLAP = 8  # following images that an image of a video is matched with, and those 16, 32, ... after it
NUM_ALIKE_VIDEO, NUM_ALIKE_PHOTOS = 5, 25  # images that look alike, per image, that are matched as well
VOCABULARY = 64  # words
MAX_SAMPLES = 400  # descriptors per image that are used
NUM_ROUNDS = 8  # of k-means

Pair = tuple[int, int]  # indices of two images, the smaller one first


def all_pairs(num_images: int) -> list[Pair]:
    """Every pair of images."""
    return list(itertools.combinations(range(num_images), 2))


def neighbor_pairs(num_images: int) -> list[Pair]:
    """Each image with the `OVERLAP` images that follow, and with those at doubling distances after them."""
    gaps = [*range(1, OVERLAP + 1)]
    while gaps[-1] * 2 < num_images:
        gaps.append(gaps[-1] * 2)
    return [(i, i + gap) for gap in gaps for i in range(num_images - gap)]


def alike_pairs(descriptors: Sequence[Float32[np.ndarray, "_ c"]], num_alike: int) -> list[Pair]:
    """Each image with the `num_alike` images that look most like it; images without descriptors are left out.

    Args:
        descriptors: of the features of each image.
        num_alike: partners per image.

    Returns:
        The pairs, sorted, each once.
    """
    filled = [i for i, rows in enumerate(descriptors) if len(rows)]
    if len(filled) < 2:
        return []
    samples = [descriptors[i][:: -(-len(descriptors[i]) // MAX_SAMPLES)].astype(np.float32) for i in filled]
    words = _vocabulary(np.concatenate(samples))
    vectors = np.stack([_aggregate(rows, words) for rows in samples])
    likeness = vectors @ vectors.T
    np.fill_diagonal(likeness, -np.inf)
    count = min(num_alike, len(filled) - 1)
    partners = np.argsort(-likeness, axis=1, kind="stable")[:, :count]
    pairs = {tuple(sorted((filled[i], filled[j]))) for i, row in enumerate(partners.tolist()) for j in row}
    return sorted((a, b) for a, b in pairs)


def _vocabulary(rows: Float32[np.ndarray, "n c"]) -> Float32[np.ndarray, "k c"]:
    """Cluster centers of descriptors, by k-means from evenly spread rows: the same rows give the same words."""
    rows = rows[:: -(-len(rows) // (VOCABULARY * 200))]
    words = rows[np.linspace(0, len(rows) - 1, min(VOCABULARY, len(rows))).astype(int)]
    for _ in range(NUM_ROUNDS):
        nearest = _nearest(rows, words)
        counts = np.bincount(nearest, minlength=len(words))
        sums = np.zeros_like(words)
        np.add.at(sums, nearest, rows)
        words = np.where(counts[:, None] > 0, sums / np.maximum(counts, 1)[:, None], words).astype(np.float32)
    return words


def _nearest(rows: Float32[np.ndarray, "n c"], words: Float32[np.ndarray, "k c"]) -> np.ndarray:
    """Index of the word nearest to each row."""
    return np.argmin(np.sum(words * words, axis=1) - 2 * rows @ words.T, axis=1)


def _aggregate(rows: Float32[np.ndarray, "n c"], words: Float32[np.ndarray, "k c"]) -> Float32[np.ndarray, " kc"]:
    """Unit vector of the residuals of an image's descriptors, summed by word and normalized by word."""
    nearest = _nearest(rows, words)
    sums = np.zeros_like(words)
    np.add.at(sums, nearest, rows - words[nearest])
    sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-9)
    vector = sums.reshape(-1)
    return vector / max(float(np.linalg.norm(vector)), 1e-9)
