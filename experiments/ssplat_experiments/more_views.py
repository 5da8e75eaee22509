"""Quality and cost against the number of views: the paper's protocol on one long capture.

    ssplat experiment more_views --captures path/to/captures --out runs/more_views

All frames of redkitchen (without `--captures`, of `procedural:room`) are the trajectory: 16 targets uniform over it,
and the first 24, 64, 128, 256, 512 others are streamed, each number in a stream of its own, as `ssplat eval --protocol
paper --context V` does. With few views, little of the targets is covered. Writes `table.json`, `table.md` and a folder
per number of views with pictures, `metrics.json` and `split.json`. docs/model_card.md holds the numbers to expect.
"""

from pathlib import Path

from ssplat_experiments.study import at_scale
from ssplat_jax.config import preset
from ssplat_jax.core.atomic import write_atomic
from ssplat_jax.core.console import Reporter
from ssplat_jax.core.cpu_backend import make_room
from ssplat_jax.core.errors import InputError
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.data.split import paper_split
from ssplat_jax.evaluation.evaluate import evaluate
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.storage.files import write_json
from ssplat_jax.storage.weights import load_params
from ssplat_jax.streaming.session import Session

NAME, SIZE = "redkitchen", (320, 240)
COUNTS = {"cpu": (24, 64, 128, 256, 512), "smoke": (8, 16)}
ROOM_FRAMES = {"cpu": 600, "smoke": 40}


def run(captures: Path | None, out: Path, scale: str, reporter: Reporter) -> str:
    """Evaluates every number of views; the tables are written after each, so that an interruption loses little."""
    capture = _open(captures, scale)
    model, params = StreamSplat(preset("tiny")), load_params("tiny")
    rows = []
    for context in at_scale(COUNTS, scale):
        make_room()
        split = paper_split(len(capture), context)
        metrics = evaluate(Session(model, params), capture, split, out / f"{context}_views", reporter)
        rows.append(
            {
                "views": context,
                "shown": metrics["shown"]["psnr"],
                "literal": metrics["literal"]["psnr"],
                "over_black": metrics["psnr_over_black"],
                "one_exposure": metrics["psnr_one_exposure"],
                "shown_ssim": metrics["shown"]["ssim"],
                "literal_ssim": metrics["literal"]["ssim"],
                "coverage": round(sum(v["coverage"] for v in metrics["per_view"]) / len(split.targets), 3),
                "gaussians": metrics["num_gaussians"],
                "chunk_ms": metrics["chunk_ms"]["median"],
                "step_mib": round((metrics["step_memory_bytes"] or 0) / 2**20),
                "split_sha256": split.sha256[:12],
            }
        )
        write_json(out / "table.json", rows)
        write_atomic(out / "table.md", _markdown(rows).encode())
    reporter.table(f"{capture.name}: the paper's protocol", tuple(rows[0]), [tuple(row.values()) for row in rows])
    gain = rows[-1]["shown"] - rows[0]["shown"]
    return f"wrote {out}/table.json: {gain:+.2f} dB (shown) from {rows[0]['views']} to {rows[-1]['views']} views"


def _open(captures: Path | None, scale: str) -> Capture:
    if captures is None:
        return open_capture(f"procedural:room?frames={at_scale(ROOM_FRAMES, scale)}", size=SIZE)
    if not (captures / NAME).is_dir():
        raise InputError(f"experiment more_views: wanted {NAME} in --captures, {captures} does not hold it.")
    return open_capture(captures / NAME, size=SIZE)


def _markdown(rows: list[dict]) -> str:
    head = "| " + " | ".join(rows[0]) + " |\n|" + "---|" * len(rows[0]) + "\n"
    return head + "".join("| " + " | ".join(str(value) for value in row.values()) + " |\n" for row in rows)
