"""Errors of estimated depths, and how well confidence predicts them.

    ssplat experiment depth_error --captures path/to/captures --out runs/depth_error

Streams captures that have depth maps with the shipped weights and compares the depth of every token with the median of
its cell's map, after one scale for the whole capture (the median ratio over accepted tokens). Writes `table.json`:
accepted fraction, median relative error of accepted tokens, that within four pixels of an edge of depth, the share of
them off every surface that the 3 x 3 cells around them show, and the error by confidence; confidence is calibrated if
the error falls as it rises. docs/results.md holds the numbers to expect.
"""

import itertools
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from numpy.lib.stride_tricks import sliding_window_view

from ssplat_experiments.streams import REDKITCHEN, make_room, open_redkitchen, open_room
from ssplat_experiments.study import at_scale
from ssplat_jax.config import preset
from ssplat_jax.core.console import Reporter
from ssplat_jax.core.errors import InputError
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.split import Split
from ssplat_jax.model.hpda import cell_depths
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.model.views import GRID_STRIDE
from ssplat_jax.storage.files import write_json
from ssplat_jax.storage.weights import load_params
from ssplat_jax.streaming.session import Session, feed_chunks

SIZE = (320, 240)
CONTEXT = {"cpu": 64, "smoke": 8}
EDGE = 1.05  # depth ratio of neighboring pixels above which an edge lies between them
OFF = 0.02  # relative distance of a token from the nearest depth around it, above which it is off all surfaces
BIN_EDGES = (0.0, 0.3, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)  # bins of confidence


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
            f"{row['capture']}: {row['accepted']:.0%} accepted, median error {row['median_error']:.1%}"
            f" ({row['median_error_at_edges']:.1%} at edges, {row['off_surfaces']:.1%} off all surfaces)",
            ("confidence", "tokens", "median error"),
            [(entry["confidence"], entry["tokens"], entry["median_error"]) for entry in row["by_confidence"]],
        )
    return f"wrote {out}/table.json: " + ", ".join(f"{r['capture']} {r['median_error']:.1%}" for r in rows)


def measure(capture: Capture, split: Split) -> dict[str, Any]:
    """One row: errors of the tokens of the context views."""
    model = StreamSplat(preset("tiny"))
    stream_frame = capture.stream_frame(model.config, split.context)
    order = capture.stream_order(model.config, split.context, stream_frame)
    session = Session(model, load_params("tiny"))
    found: list[tuple[np.ndarray, ...]] = []
    for fed in feed_chunks(session, capture, order, stream_frame):
        for v, i in enumerate(fed.frames):  # padded views come last
            depth = capture.depth(i)
            if depth is None:
                continue  # not every frame need have a map
            rows, columns = (side // GRID_STRIDE for side in depth.shape)
            depth = depth[: rows * GRID_STRIDE, : columns * GRID_STRIDE]
            truth = stream_frame.scale * np.asarray(cell_depths(jnp.asarray(depth)[None], GRID_STRIDE))[0]
            token, confidence = (np.asarray(x[v])[:rows, :columns] for x in (fed.output.depths, fed.output.confidences))
            around = token[..., None] / (stream_frame.scale * around_cells(np.where(depth > 0, depth, np.nan)))
            kept = truth > 0
            found.append((token[kept] / truth[kept], confidence[kept], near_edges(depth)[kept], around[kept]))
    if not found:
        raise InputError(f"experiment depth_error: {capture.name} has no depth map among its context frames.")
    ratios, confidences, at_edges, around = (np.concatenate(part) for part in zip(*found, strict=True))
    return summary(ratios, confidences, at_edges, around, model.config.memory.min_confidence)


def near_edges(depth: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "hf wf"]:
    """Cells within four pixels of an edge of depth, which lies between neighboring pixels whose depths are known."""
    logs, jumps = np.log(np.where(depth > 0, depth, np.nan)), np.zeros(depth.shape, bool)
    for axis in (0, 1):
        steps = np.abs(np.diff(logs, axis=axis, append=np.nan)) > np.log(EDGE)
        jumps |= steps | np.roll(steps, 1, axis)  # the last step is not known, so that nothing rolls over
    return around_cells(jumps).max(axis=-1)


def around_cells(pixels: np.ndarray) -> np.ndarray:
    """Pixels of the 3 x 3 cells around each cell; beyond the image they are NaN, or False."""
    padded = np.pad(pixels, GRID_STRIDE, constant_values=False if pixels.dtype == bool else np.nan)
    found = sliding_window_view(padded, [3 * GRID_STRIDE] * 2)[::GRID_STRIDE, ::GRID_STRIDE]
    return found.reshape(*found.shape[:2], -1)


def summary(
    ratios: Float[np.ndarray, " m"],
    confidences: Float[np.ndarray, " m"],
    at_edges: Bool[np.ndarray, " m"],
    around: Float[np.ndarray, "m n"],
    tau: float,
) -> dict[str, Any]:
    """Errors of accepted tokens, and of all by confidence, after one global scale.

    Args:
        ratios: estimated depth over that of the map.
        confidences: of the same tokens.
        at_edges: whether an edge of depth is near.
        around: estimated depth over each depth of the map around the token; NaN where it is unknown.
        tau: least confidence of an accepted token.
    """
    accepted = confidences >= tau
    scale = float(np.median(ratios[accepted]))
    errors = np.abs(ratios / scale - 1.0)
    median = lambda kept: round(float(np.median(errors[kept])), 4) if kept.any() else np.nan  # noqa: E731
    bins = []
    for low, high in itertools.pairwise(BIN_EDGES):
        inside = (confidences >= low) & ((confidences < high) | (high == BIN_EDGES[-1]))
        bins.append({"confidence": f"{low} to {high}", "tokens": int(inside.sum()), "median_error": median(inside)})
    distances = np.nanmin(np.abs(around[accepted] / scale - 1.0), axis=-1)
    return {
        "accepted": round(float(accepted.mean()), 4),
        "global_scale": round(scale, 4),
        "median_error": median(accepted),
        "median_error_at_edges": median(accepted & at_edges),
        "off_surfaces": round(float((distances > OFF).mean()), 4),
        "by_confidence": bins,
    }
