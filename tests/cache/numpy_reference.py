"""Sequential NumPy definition of the cache: fuse, project, carve, vote and observe as plain float64 loops.

It is slow, obvious and shares no code with the JAX implementation, which is tested against it. Only the voxel index is
computed in float32, because it is defined as the floor of one float32 product.

A cache is a dict: `rows` is a list of (voxel, list of pivots), and a pivot is a dict with the fields of `VoxelCache`.
Views are `viewmats` (world to camera, [v, 4, 4]) and `Ks` (in pixels of the maps, [v, 3, 3]), with maps [v, height,
width] of camera z and confidences. Functions that decide by comparison also return the margin of the closest decision,
in pixels or log depths: if it is within rounding of 0, another precision may decide otherwise.
"""

import itertools
import math

import numpy as np

from ssplat_jax.cache.state import VoxelCache, pivot_fields
from ssplat_jax.config import StreamConfig

INDEX_LIMIT = 1 << 20  # voxel indices are below it in magnitude
NEAR = 0.01  # near plane, stream units
MAX_LEVEL = 16  # of voxels
CLUSTER = math.log(1.15)  # half the width of a front cluster, log depth
SAME_DIRECTION = 1.0 - 1e-6  # similarities above it are ties


def empty(capacity: int) -> dict:
    """An empty cache."""
    names = "chunks seen accepted merged low_confidence non_finite out_of_range dropped unusable"
    return {"capacity": capacity, "rows": [], "stats": {f"num_{name}": 0 for name in names.split()}}


def from_arrays(cache: VoxelCache) -> dict:
    """A `VoxelCache` in the form of this module, without its counters."""
    arrays = {name: np.asarray(getattr(cache, name)) for name in pivot_fields(cache)}
    counts = np.asarray(cache.counts)
    pivots = [
        [{name: x[row, k].astype(np.float64) for name, x in arrays.items()} for k in range(counts[row])]
        for row in range(int(cache.num_voxels))
    ]
    voxels = np.asarray(cache.voxels).tolist()
    return {"capacity": cache.capacity, "rows": [(tuple(v), p) for v, p in zip(voxels, pivots, strict=False)]}


# Fuse -----------------------------------------------------------------------------------------------------------------


def fuse(cache: dict, tokens: dict, config: StreamConfig) -> dict:
    """Inserts `tokens` (arrays named as the fields of `Tokens`) one after another, in place."""
    stats, pivots_of = cache["stats"], {voxel: pivots for voxel, pivots in cache["rows"]}
    chunk = stats["num_chunks"]
    stats["num_chunks"] += bool(np.any(tokens["valid"]))
    for j in np.flatnonzero(tokens["valid"]):
        stats["num_seen"] += 1
        pivot = {name: np.asarray(x[j], np.float64) for name, x in tokens.items() if name != "valid"}
        voxel = voxel_of(tokens["means"][j], tokens["footprints"][j], config)
        if not (all(np.isfinite(x).all() for x in pivot.values()) and pivot["footprints"] > 0):
            stats["num_non_finite"] += 1
        elif pivot["confidences"] < np.float32(config.memory.min_confidence):
            stats["num_low_confidence"] += 1
        elif voxel is None:
            stats["num_out_of_range"] += 1
        else:
            pivot |= {"seeds": pivot["feats"], "num_members": 1, "last_chunks": chunk}
            if config.head.evidence:
                pivot["observations"] = np.zeros(9)
            if config.stream.steps_per_chunk:
                pivot["changes"] = np.zeros(14 * config.head.gaussians_per_token)
            _insert(cache, pivots_of, voxel, pivot, config)
    return cache


def voxel_of(point: np.ndarray, footprint: float, config: StreamConfig) -> tuple[int, ...] | None:
    """Three indices and the level of the voxel of a float32 point; None if it is out of range."""
    per_unit, level = np.float32(1.0 / config.memory.voxel_size), 0
    if config.additions.detail and np.isfinite(footprint) and footprint > 0:
        sides = np.float32(footprint) * per_unit
        while sides >= 2 and level < MAX_LEVEL:
            sides, level = sides / 2, level + 1
        while sides < 1 and level > -MAX_LEVEL:
            sides, level = sides * 2, level - 1
    with np.errstate(all="ignore"):
        cells = np.floor(np.float32(point) * per_unit * np.float32(2.0**-level))
    return (*(int(c) for c in cells), level) if np.all(np.abs(cells) < INDEX_LIMIT) else None


def _insert(cache, pivots_of, voxel, pivot, config):
    """Inserts a pivot into its voxel; with `vacc="append"` into the last row, whatever its voxel."""
    rows, stats, k = cache["rows"], cache["stats"], config.memory.pivots_per_voxel
    is_appended = config.memory.vacc == "append"
    voxel = None if is_appended else voxel
    pivots = pivots_of.get(voxel)
    if pivots is None or (is_appended and len(pivots) == k):
        if len(rows) == cache["capacity"]:
            stats["num_dropped"] += 1
            return
        pivots = pivots_of[voxel] = []
        rows.append((voxel, pivots))
    stats["num_accepted"] += 1
    if len(pivots) < k:
        pivots.append(pivot)
    else:
        stats["num_merged"] += 1
        merge_closest(pivots, pivot)


def merge_closest(pivots: list, new: dict) -> None:
    """Adds `new` to the full list `pivots` and merges the closest pair, the lowest among equals, in place."""
    candidates = [*pivots, new]
    pairs = itertools.combinations(range(len(candidates)), 2)
    i, j = max(pairs, key=lambda pair: similarity(*(candidates[c]["seeds"] for c in pair)))
    merged = merge(candidates[i], candidates[j])
    if j < len(pivots):
        pivots[j] = new
    pivots[i] = merged


def similarity(a: np.ndarray, b: np.ndarray) -> float:
    """cos |cos| of two vectors, which orders pairs as the cosine does: 0 if a norm is 0, 1 if the directions agree."""
    dot, product = float(np.dot(a, b)), float(np.dot(a, a)) * float(np.dot(b, b))
    score = dot * abs(dot) / product if product > 0 else 0.0
    return 1.0 if score > SAME_DIRECTION else score


def merge(older: dict, newer: dict) -> dict:
    """The pivot that replaces two; `older` is the one in the lower slot."""
    w, x = float(older["confidences"]), float(newer["confidences"])
    best = newer if x > w else older
    if w + x == 0:
        w = x = 0.5
    merged = {name: best[name] for name in ("seeds", "confidences", "quats", "footprints")}
    for name in ("means", "feats", "rgbs", "changes"):
        if name in older:
            merged[name] = (w * older[name] + x * newer[name]) / (w + x)
    for name in ("num_members", "observations"):
        if name in older:
            merged[name] = older[name] + newer[name]
    return merged | {"last_chunks": max(older["last_chunks"], newer["last_chunks"])}


# Project --------------------------------------------------------------------------------------------------------------


def project(cache: dict, viewmats, Ks, height: int, width: int, config: StreamConfig) -> tuple:
    """Depths, confidences, features, mask and colors of the cache in each view, and the margin."""
    min_confidence = np.float32(config.memory.min_confidence) if config.memory.carving else 0.0
    window = CLUSTER if config.additions.front_cluster else math.inf
    pivots = [pivot for pivot in _all_pivots(cache) if pivot["confidences"] >= min_confidence]
    shape = (len(viewmats), height, width)
    depths, confidences, mask = np.zeros(shape), np.zeros(shape), np.zeros(shape, bool)
    feats, colors, margins = np.zeros((*shape, config.network.token_width)), np.zeros((*shape, 3)), [math.inf]
    for v in range(len(viewmats)):
        for (row, column), pairs in _on_pixels(pivots, viewmats[v], Ks[v], height, width, margins).items():
            cluster = _front_cluster(pairs, window, margins)
            total = sum(p["confidences"] for _, p in cluster)
            at = (v, row, column)
            mask[at] = True
            depths[at] = math.exp(sum(p["confidences"] * ell for ell, p in cluster) / total)
            confidences[at] = sum(p["confidences"] ** 2 for _, p in cluster) / total
            feats[at] = sum(p["confidences"] * p["feats"] for _, p in cluster) / total
            colors[at] = sum(p["confidences"] * _color(p) for _, p in cluster) / total
    return depths, confidences, feats, mask, colors, min(margins)


def _all_pivots(cache):
    return [pivot for _, row in cache["rows"] for pivot in row]


def _color(pivot):
    return pivot["rgbs"].reshape(-1, 3).mean(axis=0)


def _on_pixels(pivots, viewmat, K, height, width, margins) -> dict:
    """The visible pivots as (log depth, pivot), by pixel (row, column)."""
    viewmat, K = np.asarray(viewmat, np.float64), np.asarray(K, np.float64)
    pixels: dict = {}
    for pivot in pivots:
        x, y, z = viewmat[:3, :3] @ pivot["means"] + viewmat[:3, 3]
        margins.append(abs(z - NEAR))
        if z <= NEAR or pivot["confidences"] <= 0:
            continue
        column, row = K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]
        margins += [abs(column - round(column)), abs(row - round(row))]
        if 0 <= column < width and 0 <= row < height:
            pixels.setdefault((math.floor(row), math.floor(column)), []).append((math.log(z), pivot))
    return pixels


def _front_cluster(pairs, window, margins) -> list:
    """The pairs in the front window of one pixel, re-centered once."""
    front = min(ell for ell, _ in pairs)
    members = [(ell, p["confidences"]) for ell, p in pairs if ell <= front + window]
    center = sum(w * ell for ell, w in members) / sum(w for _, w in members)
    margins += [abs(ell - front - window) for ell, _ in pairs]
    margins += [abs(abs(ell - center) - window) for ell, _ in pairs]
    return [(ell, p) for ell, p in pairs if abs(ell - center) <= window]


# Votes ----------------------------------------------------------------------------------------------------------------


def carve(cache: dict, viewmats, Ks, depths, confidences, config: StreamConfig) -> float:
    """Revises the confidences of the pivots in place by the votes of views; returns the margin."""
    views = []
    for viewmat, K, depth, confidence in zip(viewmats, Ks, depths, confidences, strict=True):
        ell = _trusted_log_depths(depth, confidence, config)
        around = np.pad(ell, 1, constant_values=math.inf)
        nearest = np.array([[around[r : r + 3, c : c + 3].min() for c in range(ell.shape[1])] for r in range(len(ell))])
        views.append((viewmat, K, ell, nearest, confidence))
    return _revise(_all_pivots(cache), views)


def stored_depths(viewmats, Ks, depths, confidences, side: int, config: StreamConfig) -> tuple | None:
    """Stored depths of a chunk: its view with the most trusted cells, reduced to `side` x `side` parts.

    Returns:
        (viewmat, K, log depths, the same log depths, weights), as `vote` takes them; None without a trusted cell.
    """
    trusted = [_trusted_log_depths(d, c, config) for d, c in zip(depths, confidences, strict=True)]
    view = int(np.argmax([np.isfinite(ell).sum() for ell in trusted]))
    ell, confidence = trusted[view], np.asarray(confidences[view], np.float64)
    if not np.isfinite(ell).any():
        return None
    height, width = ell.shape
    nearest, weights = np.full((side, side), -math.inf), np.zeros((side, side))
    for row, column in itertools.product(range(side), repeat=2):
        touched = np.s_[
            row * height // side : math.ceil((row + 1) * height / side),
            column * width // side : math.ceil((column + 1) * width / side),
        ]
        if np.isfinite(ell[touched]).all():
            nearest[row, column], weights[row, column] = ell[touched].min(), confidence[touched].min()
    K = np.diag([side / width, side / height, 1.0]) @ np.asarray(Ks[view], np.float64)
    return viewmats[view], K, nearest, nearest, weights


def vote(stored: list[tuple], tokens: dict, config: StreamConfig) -> tuple[np.ndarray, float]:
    """Confidences of `tokens` after the votes of stored depths, and the margin."""
    revised = np.asarray(tokens["confidences"], np.float64).copy()
    chosen = np.flatnonzero(tokens["valid"] & (tokens["confidences"] >= np.float32(config.memory.min_confidence)))
    points = [{"means": np.asarray(tokens["means"][j], np.float64), "confidences": revised[j]} for j in chosen]
    margin = _revise(points, stored)
    revised[chosen] = [point["confidences"] for point in points]
    return revised, margin


def _trusted_log_depths(depths, confidences, config) -> np.ndarray:
    """Log depth in trusted cells, -inf elsewhere."""
    trusted = (confidences >= np.float32(config.memory.min_confidence)) & (confidences > 0) & (depths > 0)
    with np.errstate(all="ignore"):
        return np.where(trusted & np.isfinite(depths), np.log(np.asarray(depths, np.float64)), -math.inf)


def _revise(points: list, views: list[tuple]) -> float:
    """Revises the confidences of the points in place, by the cells of (viewmat, K, log depths, nearest, weights)."""
    votes, margins = {id(p): 0.0 for p in points}, [math.inf]
    for viewmat, K, ell, nearest, weights in views:
        for cell, pairs in _on_pixels(points, viewmat, K, len(ell), ell.shape[1], margins).items():
            if ell[cell] == -math.inf:
                continue
            for own, point in pairs:
                free, same = nearest[cell] - math.log(1.02), abs(own - ell[cell])
                margins += [abs(own - free), abs(same - math.log(1.1))]
                log_odds = -2.0 if own < free else 0.5 if same <= math.log(1.1) else 0.0
                votes[id(point)] += float(weights[cell]) * log_odds
    for point in points:
        if votes[id(point)]:
            known = min(max(point["confidences"], 0.02), 0.95)
            revised = 1 / (1 + (1 - known) / known * math.exp(-votes[id(point)]))
            point["confidences"] = min(max(revised, 0.02), 0.95)
    return min(margins)


# Observations ---------------------------------------------------------------------------------------------------------


def observe(cache: dict, viewmats, Ks, depths, confidences, colors, config: StreamConfig) -> float:
    """Adds what views say about the pivots to their observations, in place; returns the margin."""
    pivots, margins, near = _all_pivots(cache), [math.inf], math.log(1.03)
    tau = np.float32(config.memory.min_confidence)
    for viewmat, K, depth, confidence, color in zip(viewmats, Ks, depths, confidences, colors, strict=True):
        ell = _trusted_log_depths(depth, confidence, config)
        for cell, pairs in _on_pixels(pivots, viewmat, K, len(ell), ell.shape[1], margins).items():
            if ell[cell] == -math.inf:
                continue
            seen = []
            for own, pivot in pairs:
                offset = (own - ell[cell]) / near
                error = np.abs(np.asarray(color[cell], np.float64) - _color(pivot)).mean()
                margins.append(abs(abs(offset) - 1) * near)
                seen.append((own, pivot, offset, error))
            others = [e for _, p, o, e in seen if abs(o) <= 1 and p["confidences"] >= tau]
            for own, pivot, offset, error in seen:
                if offset < -1:
                    more = [0, 1, 0, 0, error, 0, 0, 0, 0]
                elif offset > 1:
                    more = [0, 0, 1, 0, 0, 0, 0, 0, 0]
                else:
                    size = math.log(pivot["footprints"]) - own + math.log(K[0, 0])
                    crowd, mean = math.log(max(len(others), 1)), sum(others) / max(len(others), 1)
                    more = [1, 0, 0, error, 0, offset, crowd, error - mean, size]
                pivot["observations"] = pivot["observations"] + float(confidence[cell]) * np.array(more)
    return min(margins)
