"""The reports of `ssplat run` and `ssplat eval`: a page and a contact sheet of what their folder holds."""

import shlex
from collections.abc import Sequence
from typing import Any

import numpy as np

from ssplat_jax.evaluation.pictures import evenly_spread, save_contact_sheet
from ssplat_jax.evaluation.report_page import Report, save_report
from ssplat_jax.storage.chunk_records import ChunkRecord, load_chunk_records
from ssplat_jax.storage.run_folder import RunFolder

MOST_PICTURES = 12
"""Pictures on a page; of more, evenly spread ones are shown, and the contact sheet has more of them."""

MOST_CHUNKS = 10
"""Chunks in the table of the stream; of more, evenly spread ones are shown."""

NOTE = "Left to right: the photograph, the rendered view, its depth (light near, dark far)."
SHOWN = "holes filled, at the exposure of the nearest streamed views"

FILES = (
    ("scene.ply", "the scene, in the frame and units of the capture, at the middle exposure of its views"),
    ("refined.ply", "the refined scene"),
    ("metrics.json", "every figure of this page, and more"),
    ("contact_sheet.jpg", "the pictures on one sheet"),
    ("views", "pictures of streamed views"),
    ("chunks", "a record of every chunk: cameras, exposures, time, occupancy"),
    ("deltas", "the changes of every chunk, for the viewer's time slider"),
    ("state.npz", "the saved stream, from which a stopped run continues"),
    ("split.json", "the frames that were streamed and scored"),
    ("index.json", "the same frames as an index file"),
)


def report_run(folder: RunFolder, metrics: dict[str, Any], path: str, weights: str = "") -> None:
    """Writes the report and the contact sheet of a run.

    Args:
        folder: the folder of the run, complete but for these.
        metrics: its metrics.
        path: the capture, as the user gave it.
        weights: text to add to commands that need the weights, such as ` --weights WEIGHTS`; empty for `tiny`.

    Raises:
        StorageError: a file cannot be written.
    """
    records, scores = load_chunk_records(folder.chunk_record_files()), metrics["seen_views"]
    pictures = [(folder.view(score["frame"]), _caption(score, "streamed")) for score in scores]
    save_contact_sheet(folder.contact_sheet, pictures)
    width, height = metrics["size"]
    shown = np.mean([score["shown"]["psnr"] for score in scores])
    facts = [
        ("views streamed", f"{metrics['views']}"),
        ("Gaussians in the scene", f"{metrics['ply']['num_written']:,}"),
        (f"streamed views as shown, mean of {len(scores)}", f"{shown:.2f} dB"),
    ]
    if records:
        facts.append(("a chunk, median", f"{np.median([r.seconds for r in records]):.2f} s"))
        facts.append(("of the cache in use", f"{records[-1].occupancy:.0%}"))
    if held_back := [r.held_back_psnr for r in records if r.held_back_psnr is not None]:
        facts.append(("held-back views as shown", f"{held_back[-1]:.2f} dB"))
    out, capture, film = map(shlex.quote, (str(folder.path), path, f"{folder.path}_film"))
    report = Report(
        title=metrics["capture"],
        summary=f"A scene of 3D Gaussians from {metrics['views']} views of {width} x {height} pixels, streamed once.",
        facts=facts,
        stream=_stream_rows(records),
        pictures=[pictures[k] for k in evenly_spread(len(pictures), MOST_PICTURES)],
        pictures_note=f"{NOTE} Scores of views that the scene was made from, {SHOWN}.",
        files=_files(folder),
        commands=[
            f"ssplat view {out}    # in a browser",
            f"ssplat refine {out} {capture} --steps 100{weights}    # revises the scene until it fits its views better",
            f"ssplat render {out} {capture} --size {width}x{height} --film 8 --out {film}    # a film",
            f"ssplat export {out} --to scene.sog{weights}    # for other viewers, at an eighth of the size",
        ],
        details=_details(metrics),
    )
    save_report(folder.report, report)


def report_eval(folder: RunFolder, metrics: dict[str, Any]) -> None:
    """Writes the report and the contact sheet of an evaluation.

    Args:
        folder: the folder of the evaluation, complete but for these.
        metrics: its metrics.

    Raises:
        StorageError: a file cannot be written.
    """
    scores, shown, literal = metrics["per_view"], metrics["shown"], metrics["literal"]
    pictures = [(folder.target(score["frame"]), _caption(score, "unseen")) for score in scores]
    save_contact_sheet(folder.contact_sheet, pictures)
    facts = [
        ("PSNR as shown", f"{shown['psnr']:.2f} dB"),
        ("SSIM as shown", f"{shown['ssim']:.3f}"),
        ("PSNR, literal", f"{literal['psnr']:.2f} dB"),
        ("PSNR of copying the nearest view", f"{metrics['baselines']['nearest_view_psnr']:.2f} dB"),
        ("a chunk, median", f"{metrics['chunk_ms']['median']:.0f} ms"),
        ("Gaussians in the scene", f"{metrics['num_gaussians']:,}"),
    ]
    if refined := metrics.get("refinement"):
        facts.append(("PSNR as shown, before refinement", f"{refined['before']['shown']['psnr']:.2f} dB"))
    report = Report(
        title=metrics["capture"],
        summary=f"{metrics['target_views']} views that were never streamed, rendered from a scene of"
        f" {metrics['context_views']} other views.",
        facts=facts,
        pictures=[pictures[k] for k in evenly_spread(len(pictures), MOST_PICTURES)],
        pictures_note=f"{NOTE} Shown: {SHOWN}. Literal: over black, at the exposure of the first views.",
        files=_files(folder),
        details=[("protocol", metrics["protocol"]), *_details(metrics)],
    )
    save_report(folder.report, report)


def _stream_rows(records: Sequence[ChunkRecord]) -> list[tuple[str, ...]]:
    """Time, occupancy, scene size and held-back score over the views streamed, below a header; empty without chunks."""
    rows = [("views", "time of a chunk", "cache in use", "Gaussians", "held-back views as shown", "exposure (RGB)")]
    for k in evenly_spread(len(records), MOST_CHUNKS):
        r = records[k]
        psnr = "" if r.held_back_psnr is None else f"{r.held_back_psnr:.2f} dB"
        exposure = " ".join(f"{factor:.2f}" for factor in np.mean([view.exposure for view in r.views], axis=0))
        figures = (f"{r.num_views}", f"{r.seconds:.2f} s", f"{r.occupancy:.0%}", f"{r.num_gaussians:,}")
        rows.append((*figures, psnr, exposure))
    return rows if records else []


def _caption(score: dict[str, Any], kind: str) -> str:
    """Frame and scores of a picture."""
    shown, literal = score["shown"], score["literal"]
    return (
        f"{kind} frame {score['frame']} · shown {shown['psnr']:.2f} dB, SSIM {shown['ssim']:.3f}"
        f" · literal {literal['psnr']:.2f} dB"
    )


def _files(folder: RunFolder) -> list[tuple[str, str]]:
    """Files of the folder. A run writes its metrics after the report: with them, everything is there."""
    last = folder.metrics.name
    return [(name, text) for name, text in FILES if name == last or (folder.path / name).exists()]


def _details(metrics: dict[str, Any]) -> list[tuple[str, str]]:
    """Facts for those who look closer."""
    cache, frame = metrics["cache"], metrics["stream_frame"]
    rows = [
        ("size", " x ".join(map(str, metrics["size"]))),
        ("voxels", f"{cache['voxels']:,} of {cache['capacity']:,}"),
        ("tokens accepted", f"{cache['accepted_fraction']:.1%}"),
        ("near and far", f"{frame['near'] / frame['scale']:.4g} and {frame['far'] / frame['scale']:.4g} capture units"),
        ("compiling", f"{metrics['compile_s']:.1f} s"),
        ("configuration", metrics["config_hash"]),
    ]
    if frame.get("warning"):
        rows.append(("warning", frame["warning"]))
    return rows
