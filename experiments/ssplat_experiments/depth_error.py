"""Errors of estimated depths, and how well confidence predicts them.

    ssplat experiment depth_error --captures path/to/captures --out runs/depth_error

Streams captures that have depth maps with the shipped weights and compares the depth of every token with the median of
its cell's map, after one scale for the whole capture (the median ratio over accepted tokens). Writes `table.json`:
accepted fraction, median relative error of accepted tokens, and the error by confidence; confidence is
calibrated if the error falls as it rises. Weights whose confidences differ are compared at equal shares of the tokens,
the surest ones. docs/results.md holds the numbers to expect.
"""

import itertools
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ssplat_experiments.streams import REDKITCHEN, make_room, open_redkitchen, open_room
from ssplat_experiments.study import at_scale
from ssplat_jax.config import preset
from ssplat_jax.core.console import Reporter
from ssplat_jax.core.errors import InputError
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.split import Split
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.model.views import GRID_STRIDE
from ssplat_jax.storage.files import write_json
from ssplat_jax.storage.weights import load_params
from ssplat_jax.streaming.session import Session, feed_chunks

SIZE = (320, 240)
CONTEXT = {"cpu": 64, "smoke": 8}
EDGE = 1.05  # depth ratio within a cell above which it shows two surfaces
BIN_EDGES = (0.0, 0.3, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)  # bins of confidence
SHARES = (0.25, 0.5, 0.75, 0.85, 1.0)  # of all tokens, the surest ones


def run(captures: Path | None, out: Path, scale: str, reporter: Reporter) -> str:
    """Measures `procedural:room` and, where `--captures` has it, redkitchen."""
    context = at_scale(CONTEXT, scale)
    scenes = {"room": open_room(context, SIZE)}
    if captures is not None and (captures / REDKITCHEN).is_dir():
        scenes[REDKITCHEN] = open_redkitchen(captures, context, SIZE)
    else:
        reporter.warn(f"{REDKITCHEN}: not under --captures, left out")
    rows: list[dict[str, Any]] = []
    for name, (capture, split) in scenes.items():
        make_room()
        rows.append({"capture": name} | measure(capture, split))
    write_json(out / "table.json", rows)
    for row in rows:
        reporter.table(
            f"{row['capture']}: {row['accepted']:.0%} accepted, median error {row['median_error']:.1%}",
            ("confidence", "tokens", "median error"),
            [(entry["confidence"], entry["tokens"], entry["median_error"]) for entry in row["by_confidence"]],
        )
        reporter.table(
            f"{row['capture']}: the surest tokens",
            ("share of all", "median error"),
            [(f"{entry['share']:.0%}", entry["median_error"]) for entry in row["by_share"]],
        )
    return f"wrote {out}/table.json: " + ", ".join(f"{r['capture']} {r['median_error']:.1%}" for r in rows)


def measure(capture: Capture, split: Split) -> dict[str, Any]:
    """One row: errors of the tokens of the context views."""
    model = StreamSplat(preset("tiny"))
    stream_frame = capture.stream_frame(model.config, split.context)
    order = capture.stream_order(model.config, split.context, stream_frame)
    session = Session(model, load_params("tiny"))
    ratios, confidences = [], []
    for fed in feed_chunks(session, capture, order, stream_frame):
        for v, i in enumerate(fed.frames):  # padded views come last
            depth = capture.depth(i)
            if depth is None:
                continue  # not every frame need have a map
            truth = stream_frame.scale * cell_depths(depth)
            rows, columns = truth.shape
            ratio = np.asarray(fed.output.depths[v])[:rows, :columns] / np.where(truth > 0, truth, np.nan)
            ratios.append(ratio[truth > 0])
            confidences.append(np.asarray(fed.output.confidences[v])[:rows, :columns][truth > 0])
    if not ratios:
        raise InputError(f"experiment depth_error: {capture.name} has no depth map among its context frames.")
    return summary(np.concatenate(ratios), np.concatenate(confidences), model.config.memory.min_confidence)


def cell_depths(depth: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "hf wf"]:
    """Median of the known depths of each whole grid cell; 0 where fewer than half of its pixels are known.

    The median of an even number is the mean of the middle two, or the nearer if an edge lies between them.
    """
    rows, columns = (side // GRID_STRIDE for side in depth.shape)
    cells = depth[: rows * GRID_STRIDE, : columns * GRID_STRIDE].reshape(rows, GRID_STRIDE, columns, GRID_STRIDE)
    cells = np.moveaxis(cells, 2, 1).reshape(rows, columns, -1)
    known = np.sort(np.where(cells > 0, cells, np.inf), axis=-1)
    num_known = (cells > 0).sum(axis=-1)
    lower, upper = (
        np.take_along_axis(known, np.clip(i, 0, cells.shape[-1] - 1)[..., None], axis=-1)[..., 0]
        for i in ((num_known - 1) // 2, num_known // 2)
    )
    middle = np.where(upper <= EDGE * lower, 0.5 * (lower + upper), lower)
    return np.where(2 * num_known >= cells.shape[-1], middle, 0.0).astype(np.float32)


def summary(ratios: Float[np.ndarray, " m"], confidences: Float[np.ndarray, " m"], tau: float) -> dict[str, Any]:
    """Errors of accepted tokens, by confidence, and of the surest tokens, after one global scale."""
    accepted = confidences >= tau
    scale = float(np.median(ratios[accepted]))
    errors = np.abs(ratios / scale - 1.0)
    bins = []
    for low, high in itertools.pairwise(BIN_EDGES):
        inside = (confidences >= low) & ((confidences < high) | (high == BIN_EDGES[-1]))
        error = round(float(np.median(errors[inside])), 4) if inside.any() else None
        bins.append({"confidence": f"{low} to {high}", "tokens": int(inside.sum()), "median_error": error})
    return {
        "accepted": round(float(accepted.mean()), 4),
        "global_scale": round(scale, 4),
        "median_error": round(float(np.median(errors[accepted])), 4),
        "by_confidence": bins,
        "by_share": [
            {"share": share, "median_error": round(_surest(errors, confidences, share), 4)} for share in SHARES
        ],
    }


def _surest(errors: Float[np.ndarray, " m"], confidences: Float[np.ndarray, " m"], share: float) -> float:
    """Median error of a share of the tokens, the most confident ones."""
    order = np.argsort(-confidences, kind="stable")
    return float(np.median(errors[order[: max(1, round(share * len(order)))]]))
