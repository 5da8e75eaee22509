"""Codebooks of 256 values, and palettes of vectors, fitted to the numbers of a scene."""

import numpy as np
from jaxtyping import Float, Float64, Int, UInt8

NUM_CODES = 256
NUM_ROUNDS = 8
"""Rounds of Lloyd's algorithm for a codebook; more change the mean error by less than 1 %."""

MAX_PALETTE = 65536
"""Entries that 16-bit labels tell apart."""
FITTED_PALETTE = 4096
"""Entries of a palette that is fitted because there are more different vectors than `MAX_PALETTE`."""
PALETTE_ROUNDS = 4
BATCH = 8192
"""Vectors compared with a palette at once, 256 MB of distances."""


def fit_codebook(values: Float[np.ndarray, "*n"]) -> Float64[np.ndarray, " 256"]:
    """256 values in rising order near which the `values` lie: Lloyd's algorithm in one dimension.

    Values that differ in at most 256 ways are their own codebook.
    """
    ordered = np.sort(np.asarray(values, np.float32).astype(np.float64).reshape(-1))
    different = np.unique(ordered)
    if len(different) <= NUM_CODES:
        return np.pad(
            different if len(different) else np.zeros(1), (0, NUM_CODES - max(len(different), 1)), mode="edge"
        )
    # Half of the codes at quantiles, half evenly spaced: rare values far out get some too.
    quantiles = ordered[np.linspace(0, len(ordered) - 1, NUM_CODES // 2).round().astype(int)]
    codes = np.sort(np.concatenate([quantiles, np.linspace(ordered[0], ordered[-1], NUM_CODES // 2)]))
    sums = np.concatenate([[0.0], np.cumsum(ordered)])
    for _ in range(NUM_ROUNDS):
        borders = np.searchsorted(ordered, 0.5 * (codes[1:] + codes[:-1]))
        ends = np.concatenate([[0], borders, [len(ordered)]])
        counts = np.diff(ends)
        codes = np.where(counts > 0, np.diff(sums[ends]) / np.maximum(counts, 1), codes)
    return np.sort(codes)


def nearest_codes(values: Float[np.ndarray, "*n"], codes: Float64[np.ndarray, " 256"]) -> UInt8[np.ndarray, "*n"]:
    """Index of the code nearest to each value."""
    return np.searchsorted(0.5 * (codes[1:] + codes[:-1]), values).astype(np.uint8)


def palette(
    vectors: Float64[np.ndarray, "n d"],
) -> tuple[Int[np.ndarray, " n"], Float64[np.ndarray, "p d"]]:
    """Labels of vectors and the palette they point into: the vectors themselves, or 4096 fitted to more than 65,536."""
    different, labels = np.unique(vectors.astype(np.float32), axis=0, return_inverse=True)
    if len(different) <= MAX_PALETTE:
        return labels.reshape(-1), different.astype(np.float64)
    entries = vectors[np.linspace(0, len(vectors) - 1, FITTED_PALETTE).round().astype(int)]
    for _ in range(PALETTE_ROUNDS):
        labels = _nearest(vectors, entries)
        counts = np.bincount(labels, minlength=len(entries))
        sums = np.stack([np.bincount(labels, column, len(entries)) for column in vectors.T], axis=1)
        entries = np.where(counts[:, None] > 0, sums / np.maximum(counts, 1)[:, None], entries)
    return _nearest(vectors, entries), entries


def _nearest(vectors: Float64[np.ndarray, "n d"], entries: Float64[np.ndarray, "p d"]) -> Int[np.ndarray, " n"]:
    halves = 0.5 * np.sum(entries * entries, axis=1)
    batches = [np.argmax(vectors[i : i + BATCH] @ entries.T - halves, axis=1) for i in range(0, len(vectors), BATCH)]
    return np.concatenate(batches)
