"""Sequential NumPy definition of the cache: fuse, project, carve, judge and sightings as plain float64 loops.

It is slow, obvious and shares no code with the JAX implementation, which is tested against it. Only the voxel index is
computed in float32, because it is defined as the floor of one float32 product.
"""

import itertools
import math

import numpy as np

from ssplat_jax.cache.state import VoxelCache, pivot_fields
from ssplat_jax.config import StreamConfig

INDEX_LIMIT = 1 << 20  # voxel indices are below it in magnitude
NEAR = 0.01  # near plane, stream units
SAME_DIRECTION = 1.0 - 1e-6  # similarities above it are ties


def empty(capacity: int) -> dict:
    """An empty cache: `rows` is a list of (voxel, list of pivots), and a pivot is a dict."""
    names = "chunks seen accepted merged low_confidence non_finite out_of_range dropped"
    return {"capacity": capacity, "rows": [], "stats": {f"num_{name}": 0 for name in names.split()}}


def fuse(cache: dict, tokens: dict, config: StreamConfig) -> dict:
    """Inserts `tokens` (arrays named as the fields of `Tokens`) one after another, in place."""
    stats = cache["stats"]
    chunk = stats["num_chunks"]
    stats["num_chunks"] += bool(np.any(tokens["valid"]))
    accepted = []
    for j in range(len(tokens["valid"])):
        if not tokens["valid"][j]:
            continue
        stats["num_seen"] += 1
        pivot = {name: np.asarray(x[j], np.float64) for name, x in tokens.items() if name != "valid"}
        voxel = voxel_of(tokens["means"][j], config.memory.voxel_size)
        if not all(np.isfinite(x).all() for x in pivot.values()):
            stats["num_non_finite"] += 1
        elif pivot["confidences"] < np.float32(config.memory.min_confidence):
            stats["num_low_confidence"] += 1
        elif voxel is None:
            stats["num_out_of_range"] += 1
        else:
            pivot |= {"seeds": pivot["feats"], "num_members": 1, "last_chunks": chunk}
            if config.head.evidence:
                pivot["sightings"] = np.zeros(9)
            if config.stream.steps_per_chunk:
                pivot["residuals"] = np.zeros(14 * config.head.gaussians_per_token)
            accepted.append((voxel, pivot))
    if config.memory.vacc == "append":
        _append_all(cache, accepted, config)
    else:
        _insert_all(cache, accepted, config)
    return cache


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


def voxel_of(point: np.ndarray, voxel_size: float) -> tuple[int, ...] | None:
    """Index triple of a float32 point; None if it is out of range."""
    with np.errstate(all="ignore"):
        cells = np.floor(np.float32(point) * np.float32(1.0 / voxel_size))
    return tuple(int(c) for c in cells) if np.all(np.abs(cells) < INDEX_LIMIT) else None


def _insert_all(cache, accepted, config):
    rows, stats = cache["rows"], cache["stats"]
    row_of = {voxel: row for row, (voxel, _) in enumerate(rows) if voxel is not None}
    for voxel, pivot in accepted:
        if voxel not in row_of:
            if len(rows) < cache["capacity"]:
                rows.append((voxel, []))
                row_of[voxel] = len(rows) - 1
            else:
                stats["num_dropped"] += 1
                continue
        stats["num_accepted"] += 1
        pivots = rows[row_of[voxel]][1]
        if len(pivots) < config.memory.pivots_per_voxel:
            pivots.append(pivot)
        else:
            stats["num_merged"] += 1
            merge_closest(pivots, pivot)


def _append_all(cache, accepted, config):
    rows, stats = cache["rows"], cache["stats"]
    for _, pivot in accepted:
        if not rows or len(rows[-1][1]) == config.memory.pivots_per_voxel:
            if len(rows) == cache["capacity"]:
                stats["num_dropped"] += 1
                continue
            rows.append((None, []))
        stats["num_accepted"] += 1
        rows[-1][1].append(pivot)


def merge_closest(pivots: list, new: dict) -> None:
    """Adds `new` to the full list `pivots` and merges the closest pair, in place."""
    candidates = [*pivots, new]
    best, best_score = (0, 1), -math.inf
    for i, j in itertools.combinations(range(len(candidates)), 2):
        score = similarity(candidates[i]["seeds"], candidates[j]["seeds"])
        if score > best_score:
            best, best_score = (i, j), score
    i, j = best
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
    weights = [float(x["confidences"]) for x in (older, newer)]
    best = newer if weights[1] > weights[0] else older
    if sum(weights) == 0:
        weights = [0.5, 0.5]
    mean = {
        name: (weights[0] * older[name] + weights[1] * newer[name]) / sum(weights)
        for name in ("means", "feats", "rgbs", "residuals")
        if name in older
    }
    kept = {name: best[name] for name in ("seeds", "confidences", "quats", "footprints")}
    sums = {name: older[name] + newer[name] for name in ("sightings",) if name in older}
    return (
        mean
        | kept
        | sums
        | {
            "num_members": older["num_members"] + newer["num_members"],
            "last_chunks": max(older["last_chunks"], newer["last_chunks"]),
        }
    )


def project(cache: dict, viewmats, Ks, height: int, width: int, config: StreamConfig) -> tuple:
    """The projection of the cache into views.

    Args:
        cache: in the form of this module.
        viewmats: world to camera, `[v, 4, 4]`.
        Ks: intrinsics in pixels of the maps, `[v, 3, 3]`.
        height: of the maps.
        width: of the maps.
        config: `front_cluster`, and with `carving` also `min_confidence`.

    Returns:
        Depths, confidences, features, mask and colors of each view, and the margin of the closest decision in pixels
        or log depths. If the margin is within rounding of 0, another precision may decide otherwise.
    """
    min_confidence = np.float32(config.memory.min_confidence) if config.memory.carving else 0.0
    pivots = [pivot for _, row in cache["rows"] for pivot in row if pivot["confidences"] >= min_confidence]
    shape = (len(viewmats), height, width)
    depths, confidences, mask = np.zeros(shape), np.zeros(shape), np.zeros(shape, bool)
    feats, colors, margins = np.zeros((*shape, config.network.token_width)), np.zeros((*shape, 3)), [math.inf]
    for v in range(len(viewmats)):
        viewmat, K = np.asarray(viewmats[v], np.float64), np.asarray(Ks[v], np.float64)
        for (row, column), pairs in _on_pixels(pivots, viewmat, K, height, width, margins).items():
            cluster = _front_cluster(pairs, math.log(1.15) if config.additions.front_cluster else math.inf, margins)
            total = sum(p["confidences"] for _, p in cluster)
            at = (v, row, column)
            mask[at] = True
            depths[at] = math.exp(sum(p["confidences"] * ell for ell, p in cluster) / total)
            confidences[at] = sum(p["confidences"] ** 2 for _, p in cluster) / total
            feats[at] = sum(p["confidences"] * p["feats"] for _, p in cluster) / total
            colors[at] = sum(p["confidences"] * p["rgbs"].reshape(-1, 3).mean(axis=0) for _, p in cluster) / total
    return depths, confidences, feats, mask, colors, min(margins)


def carve(cache: dict, viewmats, Ks, depths, confidences, config: StreamConfig) -> float:
    """Revises the confidences of the pivots in place.

    Args:
        cache: in the form of this module.
        viewmats: world to camera, `[v, 4, 4]`.
        Ks: intrinsics in pixels of the maps, `[v, 3, 3]`.
        depths: camera z, `[v, height, width]`.
        confidences: of the depths.
        config: its `min_confidence` decides which cells are witnesses.

    Returns:
        The margin of the closest decision in pixels or log depths.
    """
    views = []
    for viewmat, K, depth, confidence in zip(viewmats, Ks, depths, confidences, strict=True):
        ell = _trusted_log_depths(depth, confidence, config)
        around = np.pad(ell, 1, constant_values=math.inf)
        nearest = np.array([[around[r : r + 3, c : c + 3].min() for c in range(ell.shape[1])] for r in range(len(ell))])
        views.append((viewmat, K, ell, nearest, confidence))
    return _revise([pivot for _, row in cache["rows"] for pivot in row], views)


def add_sightings(cache: dict, viewmats, Ks, depths, confidences, colors, config: StreamConfig) -> float:
    """Adds what views say about the pivots to their sightings, in place.

    Args:
        cache: in the form of this module.
        viewmats: world to camera, `[v, 4, 4]`.
        Ks: intrinsics in pixels of the maps, `[v, 3, 3]`.
        depths: camera z, `[v, height, width]`.
        confidences: of the depths.
        colors: of the cells, `[v, height, width, 3]`.
        config: its `min_confidence` decides which cells are trusted and which pivots count as others.

    Returns:
        The margin of the closest decision in pixels or log depths.
    """
    pivots, margins = [pivot for _, row in cache["rows"] for pivot in row], [math.inf]
    near = math.log(1.03)
    for viewmat, K, depth, confidence, color in zip(viewmats, Ks, depths, confidences, colors, strict=True):
        viewmat, K = np.asarray(viewmat, np.float64), np.asarray(K, np.float64)
        ell = _trusted_log_depths(depth, confidence, config)
        for cell, pairs in _on_pixels(pivots, viewmat, K, ell.shape[0], ell.shape[1], margins).items():
            if ell[cell] == -math.inf:
                continue
            weight, seen = float(confidence[cell]), []
            for own, pivot in pairs:
                offset = (own - ell[cell]) / near
                error = np.abs(np.asarray(color[cell], np.float64) - pivot["rgbs"].reshape(-1, 3).mean(axis=0)).mean()
                margins.append(abs(abs(offset) - 1) * near)
                seen.append((own, pivot, offset, error))
            tau = np.float32(config.memory.min_confidence)
            others = [e for _, p, o, e in seen if abs(o) <= 1 and p["confidences"] >= tau]
            for own, pivot, offset, error in seen:
                if offset < -1:
                    more = [0, 1, 0, 0, error, 0, 0, 0, 0]
                elif offset > 1:
                    more = [0, 0, 1, 0, 0, 0, 0, 0, 0]
                else:
                    size = math.log(pivot["footprints"]) - own + math.log(K[0, 0])
                    mean = sum(others) / max(len(others), 1)
                    more = [1, 0, 0, error, 0, offset, math.log(max(len(others), 1)), error - mean, size]
                pivot["sightings"] = pivot["sightings"] + weight * np.array(more)
    return min(margins)


def witness(viewmats, Ks, depths, confidences, side: int, config: StreamConfig) -> tuple | None:
    """The stored witness of a chunk: its view with the most trusted cells, reduced to `side` x `side` parts.

    Args:
        viewmats: world to camera, `[v, 4, 4]`.
        Ks: intrinsics in pixels of the maps, `[v, 3, 3]`.
        depths: camera z, `[v, height, width]`.
        confidences: of the depths.
        side: parts along each side of the view.
        config: its `min_confidence` decides which cells are trusted.

    Returns:
        (viewmat, K, log depths, the same log depths, weights), as `judge` takes them; None without a trusted cell.
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


def judge(witnesses: list[tuple], tokens: dict, config: StreamConfig) -> tuple[np.ndarray, float]:
    """Confidences of `tokens` revised by the witnesses, and the margin of the closest decision."""
    judged = np.asarray(tokens["confidences"], np.float64).copy()
    chosen = np.flatnonzero(tokens["valid"] & (tokens["confidences"] >= np.float32(config.memory.min_confidence)))
    points = [{"means": np.asarray(tokens["means"][j], np.float64), "confidences": judged[j]} for j in chosen]
    margin = _revise(points, witnesses)
    judged[chosen] = [point["confidences"] for point in points]
    return judged, margin


def _trusted_log_depths(depths, confidences, config) -> np.ndarray:
    """Log depth in trusted cells, -inf elsewhere."""
    trusted = (confidences >= np.float32(config.memory.min_confidence)) & (confidences > 0) & (depths > 0)
    with np.errstate(all="ignore"):
        return np.where(trusted & np.isfinite(depths), np.log(np.asarray(depths, np.float64)), -math.inf)


def _revise(points: list, views: list[tuple]) -> float:
    """Revises the confidences of the points in place, by the cells of (viewmat, K, log depths, nearest, weights)."""
    evidence, margins = {id(p): 0.0 for p in points}, [math.inf]
    for viewmat, K, ell, nearest, weights in views:
        viewmat, K = np.asarray(viewmat, np.float64), np.asarray(K, np.float64)
        seen = _on_pixels(points, viewmat, K, ell.shape[0], ell.shape[1], margins)
        for cell, pairs in seen.items():
            if ell[cell] == -math.inf:
                continue
            for own, point in pairs:
                free, same = nearest[cell] - math.log(1.02), abs(own - ell[cell])
                margins += [abs(own - free), abs(same - math.log(1.1))]
                evidence[id(point)] += float(weights[cell]) * (
                    -2.0 if own < free else 0.5 if same <= math.log(1.1) else 0.0
                )
    for point in points:
        if evidence[id(point)]:
            known = min(max(point["confidences"], 0.02), 0.95)
            judged = 1 / (1 + (1 - known) / known * math.exp(-evidence[id(point)]))
            point["confidences"] = min(max(judged, 0.02), 0.95)
    return min(margins)


def _on_pixels(pivots, viewmat, K, height, width, margins) -> dict:
    """The visible pivots as (log depth, pivot), by pixel (row, column)."""
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
