"""Novel views of real captures against copying the nearest view.

    ssplat experiment captures --captures path/to/captures --out runs/captures

Every row of `SETTINGS` whose capture stands in the given folder is evaluated with the shipped weights (the interleaved
protocol, decoded cache); a table goes to the terminal and `table.json`, pictures beside it. docs/results.md holds
the numbers to expect.
"""

from pathlib import Path

from ssplat_experiments.streams import make_room
from ssplat_jax.config import preset
from ssplat_jax.core.console import Reporter
from ssplat_jax.core.errors import InputError
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.data.split import interleaved_split
from ssplat_jax.evaluation.metrics import installed_lpips
from ssplat_jax.evaluation.scoring import evaluate
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.storage.files import write_json
from ssplat_jax.storage.weights import load_params
from ssplat_jax.streaming.session import Session

Setting = tuple[str, int, int, tuple[int, int] | None]  # capture, stride, context views, and size (None: its own)

SETTINGS: tuple[Setting, ...] = (
    ("redkitchen?depth=off", 5, 64, (320, 240)),
    ("redkitchen?depth=off", 10, 64, (320, 240)),
    ("fox", 1, 40, None),
    ("south_building", 1, 64, (320, 240)),
)
WITH_DEPTH: tuple[Setting, ...] = (("redkitchen", 5, 64, (320, 240)), ("redkitchen", 10, 64, (320, 240)))
"""Captures that are streamed with their depth maps too."""


def is_there(captures: Path, name: str) -> bool:
    """True if the capture of a setting is a folder in `captures`."""
    return (captures / name.partition("?")[0]).is_dir()


def run(captures: Path | None, out: Path, scale: str, reporter: Reporter) -> str:
    """Evaluates the captures that are there and writes the table; `smoke` takes 8 context views of each."""
    if captures is None:
        raise InputError("experiment captures: wanted --captures, a folder with captures by their names.")
    if not any(is_there(captures, name) for name, *_ in SETTINGS):
        raise InputError(f"experiment captures: {captures} holds none of {', '.join(s[0] for s in SETTINGS)}.")
    model, params = StreamSplat(preset("tiny")), load_params("tiny")
    rows = []
    for name, stride, context, size in (*SETTINGS, *WITH_DEPTH):
        make_room()
        if not is_there(captures, name):
            reporter.warn(f"{name}: not in {captures}, left out")
            continue
        capture = open_capture(captures / name, size=size)
        split = interleaved_split(len(capture), stride, context if scale != "smoke" else 8)
        folder = out / (f"{capture.name}_stride{stride}" + ("_depth" if capture.brings_depth else ""))
        lpips = installed_lpips()
        metrics = evaluate(Session(model, params), capture, split, folder, reporter, lpips_weights=lpips)
        row = {"capture": capture.name, "depth": capture.brings_depth, "stride": stride, "context": len(split.context)}
        row |= {kind: metrics[kind]["psnr"] for kind in ("shown", "literal")}
        row |= {f"{kind}_{score}": metrics[kind][score] for score in ("ssim", "lpips") for kind in ("shown", "literal")}
        row |= {"copy": metrics["baselines"]["nearest_view_psnr"], "accepted": metrics["cache"]["accepted_fraction"]}
        rows.append(row | {"gaussians": metrics["num_gaussians"], "chunk_ms": metrics["chunk_ms"]["median"]})
    reporter.table("novel views of real captures", tuple(rows[0]), [tuple(row.values()) for row in rows])
    write_json(out / "table.json", rows)
    return f"wrote {out}/table.json and pictures beside it"
