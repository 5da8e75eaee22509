"""Scores of another method's renders, on the split and against the images of a capture.

    ssplat experiment score --captures path/to/capture --renders path/to/renders --out runs/score

The folder of renders holds `split.json`, as `ssplat eval` writes it, and one image for each target, named by its frame
(`00004.png`; the `color` of pixelSplat and its heirs) or by its place among the targets (`0.png` on; the `rendering` of
Long-LRM, the `pred` of AnySplat). All images have one size, at which the capture is read. Scores are literal: the
pixels as they are, no holes filled and no exposure changed. The nearest context view and the mean color stand beside
them. The row shows the `peak_memory_bytes` of `metrics.json`, as `ssplat eval` writes it, where the folder holds one;
"OOM" there stands for a method that had no memory for the scene, and needs no images. Of many scenes both folders hold
one folder for each, and the means over views, then scenes, come last.
"""

import functools
import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ssplat_experiments.cases import Case, Row
from ssplat_experiments.study import Study, run_study
from ssplat_jax.core.console import Reporter
from ssplat_jax.core.errors import InputError, echo
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.images import decode_image, image_size
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.data.split import Split
from ssplat_jax.evaluation.cost import OOM
from ssplat_jax.evaluation.metrics import installed_lpips
from ssplat_jax.evaluation.scoring import check_scorable, mean_images, nearest_views, score_image

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp")
SPLIT, METRICS = "split.json", "metrics.json"
TEXT = """Renders of another method against the targets of a split: literal scores, of the pixels as they are. The
nearest context view and the mean color of the context stand beside them."""


def run(captures: Path | None, out: Path, scale: str, reporter: Reporter, renders: Path | None = None) -> str:
    """Scores the renders; every scale is the same."""
    if captures is None or renders is None:
        missing = "--captures, the capture itself" if captures is None else "--renders, a folder with split.json"
        raise InputError(f"experiment score: wanted {missing}; got none.")
    return run_study(study_of(str(captures), renders), None, out, scale, reporter)


def study_of(path: str, renders: Path) -> Study:
    """The study of a folder of renders, or of one for each scene.

    Args:
        path: the capture, or `procedural:NAME`; of many scenes the folder of their captures.
        renders: the folder of the renders; of many scenes it holds one for each scene, of the name of its capture.

    Raises:
        InputError: the split, a render or the capture is missing or unusable.
    """
    method, scenes = renders.resolve().name, [path.parent.name for path in sorted(renders.glob(f"*/{SPLIT}"))]
    if (renders / SPLIT).exists() or not scenes:
        return Study("score", TEXT, lambda captures, scale: [case_of(method, path, renders)])
    cases = [case_of(method, f"{path}/{scene}", renders / scene, f"{method}, {scene}") for scene in scenes]
    return Study("score", TEXT, lambda captures, scale: cases, finish=add_means)


def case_of(method: str, path: str, renders: Path, name: str | None = None) -> Case:
    """The case of one capture and its renders; of a method that had no memory for it, without any."""
    split, memory = read_split(renders / SPLIT), read_memory(renders / METRICS)
    if memory == OOM:
        asked = {"capture": path, "split": split.sha256[:12], "peak_memory_bytes": OOM}
        row = {"method": method, "capture": Path(path).name, "peak_memory_bytes": OOM}
        return Case(name or method, None, asked, lambda: [row])
    files = files_of(renders, split.targets)
    sizes = {image_size(file) for file in files.values()}
    if len(sizes) != 1:
        got = ", ".join(f"{w}x{h}" for w, h in sorted(sizes))
        raise InputError(f"{renders}: wanted renders of one size, got {got}.")
    capture = open_capture(path, size=sizes.pop())
    check_scorable(capture, with_lpips=installed_lpips() is not None)
    if max(*split.context, *split.targets) >= len(capture):
        raise InputError(f"{renders / SPLIT}: wanted frames below {len(capture)}, which {capture.name} has.")
    digest = hashlib.sha256(b"".join(files[i].read_bytes() for i in split.targets)).hexdigest()[:12]
    frames = capture.digest((*split.context, *split.targets))
    asked = {"capture": capture.name, "frames": frames, "split": split.sha256[:12], "renders": digest}
    asked |= {} if memory is None else {"peak_memory_bytes": memory}
    return Case(name or method, None, asked, functools.partial(measured, method, capture, split, files, memory))


def measured(method: str, capture: Capture, split: Split, files: dict[int, Path], memory: Any) -> list[Row]:
    """Mean scores of the renders in `files`, whose method needed `memory` bytes, and of two baselines."""
    mean = np.mean([capture.image(i).mean(axis=(0, 1)) for i in split.context], axis=0)
    flat = np.broadcast_to(mean, capture.image(split.targets[0]).shape).astype(np.float32)
    shown = {
        method: {i: decode_image(file, (capture.width, capture.height)) for i, file in files.items()},
        "copy nearest": {i: capture.image(nearest_views(capture, i, split.context)[0]) for i in split.targets},
        "mean color": dict.fromkeys(split.targets, flat),
    }
    rows = []
    for name, by_target in shown.items():
        scores = [score_image(by_target[i], capture.image(i), installed_lpips()) for i in split.targets]
        row = {"method": name, "capture": capture.name, "size": f"{capture.width}x{capture.height}"}
        row |= {f"literal_{metric}": value for metric, value in mean_images(scores).items()}
        row |= {"peak_memory_bytes": memory if name == method else None}
        rows.append(row | {"targets": len(split.targets), "split": split.sha256[:12]})
    return rows


def add_means(rows: list[Row]) -> None:
    """Adds a row for each method: means over the views of a scene, then over scenes, and the largest memory.

    A method without memory for a scene has no mean.
    """
    for method in dict.fromkeys(row["method"] for row in rows):
        own = [row for row in rows if row["method"] == method]
        memory = [row["peak_memory_bytes"] for row in own if row["peak_memory_bytes"] is not None]
        mean: Row = {"method": method, "capture": f"mean of {len(own)} scenes"}
        if OOM in memory:
            rows.append(mean | {"peak_memory_bytes": OOM})
            continue
        for metric in ("literal_psnr", "literal_ssim", "literal_lpips"):
            values = [row[metric] for row in own]
            mean[metric] = None if None in values else round(float(np.mean(values)), 4)
        rows.append(mean | {"peak_memory_bytes": max(memory, default=None), "targets": sum(r["targets"] for r in own)})


def read_split(path: Path) -> Split:
    """The split in a file.

    Raises:
        InputError: there is none, or it lacks context or targets.
    """
    try:
        fields = json.loads(path.read_text())
        context, targets = (tuple(map(int, fields[name])) for name in ("context", "targets"))
        if not context or not targets or min(context + targets) < 0:
            raise ValueError("no frames")
        return Split(str(fields["protocol"]), context, targets)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{path}: wanted a split with protocol, context and targets, got {type(error).__name__} ({error}); copy the"
            " split.json that `ssplat eval` wrote."
        ) from None


def read_memory(path: Path) -> int | str | None:
    """The peak memory in bytes that a file of metrics names, or "OOM"; None without a file, or if it names none.

    Raises:
        InputError: the file is damaged, or the number is not one of bytes.
    """
    if not path.exists():
        return None
    try:
        found = json.loads(path.read_text()).get("peak_memory_bytes")
        if found is not None and found != OOM and not (type(found) is int and found > 0):
            raise ValueError(f"peak_memory_bytes {echo(found)}")
    except (OSError, ValueError, AttributeError) as error:
        raise InputError(f"{path}: wanted metrics with a number of bytes, got {error}; remove the file.") from None
    return found


def files_of(folder: Path, targets: Sequence[int]) -> dict[int, Path]:
    """The image of each target, whose name is its frame, or its place among the targets if all names are places.

    Raises:
        InputError: a target has no image, or more than one.
    """
    found = [path for path in sorted(folder.iterdir()) if path.suffix in SUFFIXES and path.stem.isdecimal()]
    places = sorted(int(path.stem) for path in found) == list(range(len(targets)))
    files = {}
    for place, i in enumerate(targets):
        here = [path for path in found if int(path.stem) == (place if places else i)]
        if len(here) != 1:
            got = " and ".join(path.name for path in here) or "none"
            raise InputError(f"{folder}: wanted one image {i:05d}.png of target {i}, got {got}.")
        files[i] = here[0]
    return files
