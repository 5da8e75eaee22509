"""Quality of an exported scene without specks and floaters, and with fewer Gaussians.

    ssplat experiment export_selection --captures path/to/captures --out runs/export_selection

Streams the context views of `procedural:room` and, where `--captures` has them, of redkitchen and fox with the shipped
weights, leaves out what `ssplat export --prune` and `--max-splats` do, and scores the rest on unseen views. Writes
`table.json`. docs/decisions.md holds the numbers to expect.
"""

from pathlib import Path
from typing import Any

import numpy as np

from ssplat_experiments.scenes import REDKITCHEN, open_redkitchen, open_room
from ssplat_experiments.study import at_scale
from ssplat_jax.config import preset
from ssplat_jax.core.console import Reporter
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.data.split import Split, interleaved_split
from ssplat_jax.evaluation.scoring import score_targets
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.runs.export_run import members_of_gaussians
from ssplat_jax.scene_files.export_rows import is_writable
from ssplat_jax.scene_files.select_gaussians import Selection, select_gaussians
from ssplat_jax.storage.files import write_json
from ssplat_jax.storage.weights import load_params
from ssplat_jax.streaming.feed import feed_capture
from ssplat_jax.streaming.session import Session

SIZE = (320, 240)
CONTEXT = {"cpu": 40, "smoke": 8}
NUM_TARGETS = 6
FOX = "fox"
SHARES = (0.75, 0.5, 0.25)
"""Shares of the visible Gaussians that are kept."""


def run(captures: Path | None, out: Path, scale: str, reporter: Reporter) -> str:
    """Scores every selection on every capture."""
    context = at_scale(CONTEXT, scale)
    scenes = {"room": open_room(context, SIZE)}
    if captures is not None and (captures / REDKITCHEN).is_dir():
        scenes[REDKITCHEN] = open_redkitchen(captures, context, SIZE)
    if captures is not None and (captures / FOX).is_dir():
        fox = open_capture(captures / FOX, size=SIZE)
        scenes[FOX] = fox, interleaved_split(len(fox), 1, context)
    rows: list[dict[str, Any]] = []
    for name, (capture, split) in scenes.items():
        rows += [{"capture": name} | row for row in measure(capture, split)]
        write_json(out / "table.json", rows)
    reporter.table("selections", tuple(rows[0]), [tuple(row.values()) for row in rows])
    return f"wrote {out}/table.json: {len(rows)} selections"


def measure(capture: Capture, split: Split) -> list[dict[str, Any]]:
    """A row for each selection: its Gaussians and their scores."""
    model = StreamSplat(preset("tiny"))
    frame = capture.stream_frame(model.config, split.context)
    session = Session(model, load_params("tiny"))
    exposures, _ = feed_capture(session, capture, split.context, frame)
    gaussians, known = session.gaussians(), members_of_gaussians(session)
    members = np.pad(known, (0, gaussians.num_gaussians - len(known)))
    num_visible = int(is_writable(gaussians).sum())
    selections = {"everything": Selection(), "--prune": Selection(prune=True)}
    selections |= {f"--max-splats {share:.0%}": Selection(max_splats=int(share * num_visible)) for share in SHARES}
    rows = []
    for name, selection in selections.items():
        selected = select_gaussians(gaussians, selection, members)
        scores = score_targets(selected.gaussians, capture, split.targets[:NUM_TARGETS], frame, exposures)
        kept = num_visible - selected.num_pruned - selected.num_cut
        psnrs = {block: round(scores[block]["psnr"], 2) for block in ("shown", "literal")}
        rows.append({"selection": name, "gaussians": kept} | psnrs)
    return rows
