"""Selection of the Gaussians that are worth a place in a file: without specks and floaters, and at most so many."""

import dataclasses

import jax
import numpy as np
from jaxtyping import Bool, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.scene_files.export_rows import is_writable
from ssplat_jax.scene_files.morton import morton_order

NUM_NEIGHBORS = 8
"""Nearest Gaussians that each is compared with; more join no clusters that fewer leave apart on our scenes."""

REACH = 4.0
"""Two Gaussians touch if their centers are at most this many of their standard deviations, added up, apart."""

SPECK = 16
"""A cluster of fewer Gaussians than this is a speck."""

FLOATER = 64
"""A cluster of fewer Gaussians than this is a floater if one view alone made it."""

ROUNDING = 1e-9


@dataclasses.dataclass(frozen=True)
class Selection:
    """The Gaussians to write."""

    prune: bool = False
    """Leave out specks and floaters of single views (`prune_mask`)."""
    max_splats: int | None = None
    """Most Gaussians; opaque ones are kept first, everywhere alike (`thinned_mask`)."""

    def __post_init__(self) -> None:
        if self.max_splats is not None and self.max_splats < 1:
            raise InputError(f"--max-splats: wanted at least 1, got {self.max_splats}.")


EVERYTHING = Selection()


@dataclasses.dataclass(frozen=True)
class Selected:
    """Selected Gaussians, in their order in the scene, and the counts of those left out."""

    gaussians: Gaussians
    num_pruned: int
    num_cut: int  # beyond `max_splats`


def select_gaussians(
    gaussians: Gaussians, selection: Selection, num_members: Int[np.ndarray, " n"] | None = None
) -> Selected:
    """Selects the Gaussians to write; rows that no file holds (`is_writable`) stay, for the writer to count.

    Args:
        gaussians: the scene.
        selection: what to leave out.
        num_members: number of tokens that each Gaussian was merged from; None if it is not known, as in a file.

    Returns:
        The selected Gaussians and the counts of the others.
    """
    writable = is_writable(gaussians)
    keep = writable.copy()
    if selection.prune:
        members = None if num_members is None else num_members[writable]
        keep[writable] = prune_mask(_take(gaussians, writable), members)
    num_pruned = int(writable.sum() - keep.sum())
    if selection.max_splats is not None and keep.sum() > selection.max_splats:
        keep[keep] = thinned_mask(_take(gaussians, keep), selection.max_splats)
    num_cut = int(writable.sum()) - num_pruned - int(keep.sum())
    return Selected(_take(gaussians, keep | ~writable), num_pruned, num_cut)


def thinned_mask(gaussians: Gaussians, num_kept: int) -> Bool[np.ndarray, " n"]:
    """Mask of exactly `num_kept` Gaussians that stand for all of them: opaque ones first, everywhere alike.

    A Gaussian is kept with a frequency proportional to the square of its opacity, at most 1. Along the Morton order the
    frequencies are added up, and one is kept whenever the sum passes a half: no region loses more than its share.

    Args:
        gaussians: rows that can all be drawn, more than `num_kept`.
        num_kept: at least 1.
    """
    weights = np.square(np.asarray(gaussians.opacities, np.float64))
    largest_first = np.sort(weights)[::-1]
    rest = np.cumsum(largest_first[::-1])[::-1]  # sum of each weight and the smaller ones
    certain = np.arange(num_kept)
    factors = (num_kept - certain) / rest[:num_kept]  # if so many of the largest are kept for certain
    factor = factors[np.argmax(factors * largest_first[:num_kept] <= 1.0 + ROUNDING)]
    order = morton_order(np.asarray(gaussians.means, np.float64))
    sums = np.floor(np.cumsum(np.minimum(factor * weights[order], 1.0)) + 0.5)
    mask = np.zeros(len(weights), bool)
    mask[order] = np.diff(sums, prepend=0.0) > 0
    return mask


def prune_mask(gaussians: Gaussians, num_members: Int[np.ndarray, " n"] | None = None) -> Bool[np.ndarray, " n"]:
    """Mask of the Gaussians that belong to the scene; the others are specks and floaters.

    Gaussians that touch form a cluster. Surfaces are large clusters. A speck is a cluster of fewer than 16 Gaussians.
    A floater is one of fewer than 64 in which no Gaussian was merged from two tokens: no second view confirmed it.
    The largest cluster is always kept.

    Args:
        gaussians: rows that can all be drawn.
        num_members: number of tokens that each Gaussian was merged from; without it only specks are found.
    """
    if gaussians.num_gaussians == 0:
        return np.zeros(0, bool)
    labels = _clusters(gaussians)
    sizes = np.bincount(labels)
    kept = sizes >= SPECK
    if num_members is not None:
        confirmed = np.zeros(len(sizes), bool)
        confirmed[labels[num_members > 1]] = True
        kept &= confirmed | (sizes >= FLOATER)
    kept[sizes.argmax()] = True
    return kept[labels]


def _clusters(gaussians: Gaussians) -> Int[np.ndarray, " n"]:
    """Number of the cluster of each Gaussian: those that touch, directly or through others, share it."""
    means = np.asarray(gaussians.means, np.float64)
    reach = REACH * np.asarray(gaussians.scales, np.float64).max(axis=1)
    n, k = len(means), min(NUM_NEIGHBORS + 1, len(means))
    distances, neighbors = KDTree(means).query(means, k=k)
    distances, neighbors = distances.reshape(n, k), neighbors.reshape(n, k)
    rows, columns = np.nonzero(distances <= reach[:, None] + reach[neighbors])
    links = coo_array((np.ones(len(rows), bool), (rows, neighbors[rows, columns])), shape=(n, n))
    return connected_components(links, directed=False)[1]


def _take(gaussians: Gaussians, rows: Bool[np.ndarray, " n"]) -> Gaussians:
    places = np.flatnonzero(rows)
    return jax.tree.map(lambda x: x[places], gaussians)
