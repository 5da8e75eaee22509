"""Novel views of real captures against copying the nearest view.

    python -m experiments.captures path/to/captures --out runs/captures

Every row of `SETTINGS` whose capture stands in the given folder is evaluated with the shipped weights (the interleaved
protocol, decoded cache); a table goes to the terminal and `table.json`, pictures beside it. docs/model_card.md holds
the numbers to expect.
"""

import argparse
import json
from pathlib import Path

from ssplat_jax.checkpoint.weights import load_params
from ssplat_jax.config import preset
from ssplat_jax.data.capture import open_capture
from ssplat_jax.data.protocol import interleaved
from ssplat_jax.evaluate import evaluate
from ssplat_jax.session import Session
from ssplat_jax.stream import StreamSplat

SETTINGS = (  # capture, stride, context views, size (None: its own)
    ("redkitchen", 5, 64, (320, 240)),
    ("redkitchen", 10, 64, (320, 240)),
    ("fox", 1, 40, None),
    ("south_building", 1, 64, (320, 240)),
)


def main() -> None:
    """Evaluates what is there and writes the table."""
    parser = argparse.ArgumentParser(description="Novel views of real captures against copying the nearest view.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    model, params = StreamSplat(preset("tiny")), load_params("tiny")
    rows = []
    for name, stride, context, size in SETTINGS:
        if not (options.folder / name).is_dir():
            print(f"{name}: not in {options.folder}, left out")
            continue
        capture = open_capture(options.folder / name, size=size)
        split = interleaved(len(capture), stride, context)
        metrics = evaluate(Session(model, params), capture, split, options.out / f"{name}_stride{stride}")
        row = {
            "capture": name,
            "stride": stride,
            "context": context,
            "psnr": metrics["psnr"],
            "ssim": metrics["ssim"],
            "copy": metrics["baselines"]["nearest_view_psnr"],
            "accepted": metrics["cache"]["accepted_fraction"],
            "gaussians": metrics["num_gaussians"],
            "chunk_ms": metrics["chunk_ms"]["median"],
        }
        rows.append(row)
        print("  ".join(f"{key} {value}" for key, value in row.items()), flush=True)
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "table.json").write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
