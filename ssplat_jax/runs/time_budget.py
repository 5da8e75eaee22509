"""Time budget: the most accurate setting that this machine can stream in so many milliseconds a view.

The settings are those of `ssplat experiment accuracy_vs_time` that no other beats in both accuracy and time, as it
wrote them into `front.json`, which lies beside this file. Their times are kept in *reference steps*, so that one timing
tells them for another machine.
"""

import dataclasses
import json
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ssplat_jax.config import preset
from ssplat_jax.core.chunk import Chunk
from ssplat_jax.core.console import Reporter
from ssplat_jax.core.errors import InputError, refusal
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.storage.json_files import write_json
from ssplat_jax.storage.run_folder import RunFolder
from ssplat_jax.storage.weights import load_params
from ssplat_jax.streaming.session import Session

FRONT_FILE = Path(__file__).parent / "front.json"

REFERENCE_SIZE = (64, 48)
"""(width, height) of the images of the reference step, with the preset `tiny`: small, so that it compiles soon."""

NUM_REPEATS = 9
"""Timings of the reference step; the fastest counts, which other programs on the machine disturb least."""


@dataclasses.dataclass(frozen=True)
class FrontPoint:
    """A point of the Pareto front of accuracy and time: no other setting is both faster and at least as good."""

    setting: str
    factor: float
    """Size of the streamed images against those of the capture."""
    changes: dict[str, Any]
    """Fields that differ from the preset `tiny`."""
    steps_per_view: float
    """Time of one view, chunk in to novel view out, in reference steps."""
    shown: float
    """PSNR of unseen views in dB, as shown."""


@dataclasses.dataclass(frozen=True)
class Front:
    """The Pareto front, and the size of the images at which its times hold."""

    size: tuple[int, int]
    points: tuple[FrontPoint, ...]

    def to_dict(self) -> dict[str, Any]:
        """Dictionary of plain JSON types."""
        return dataclasses.asdict(self)


def front_of(size: Sequence[int], points: Sequence[FrontPoint]) -> Front:
    """The points that no other point beats, the fastest first."""
    kept: list[FrontPoint] = []
    best = -math.inf
    for point in sorted(points, key=lambda point: (point.steps_per_view, -point.shown)):
        if point.shown > best:
            kept.append(point)
            best = point.shown
    return Front((int(size[0]), int(size[1])), tuple(kept))


def load_front(path: Path = FRONT_FILE) -> Front:
    """The front that is shipped with the package."""
    fields = json.loads(path.read_text())
    return front_of(fields["size"], [FrontPoint(**point) for point in fields["points"]])


def choose(
    front: Front, budget_ms: float, size: tuple[int, int], reference_ms: float, *, max_factor: float = math.inf
) -> tuple[FrontPoint, float]:
    """The most accurate point that fits into a budget, and its expected milliseconds a view.

    Args:
        front: the points.
        budget_ms: milliseconds a view, chunk in to novel view out.
        size: (width, height) of the capture's images; times grow with their pixels.
        reference_ms: milliseconds of the reference step on this machine.
        max_factor: points that stream larger images, as a factor of `size`, are left out.

    Raises:
        InputError: the budget is no positive time, or no point fits.
    """
    if not 0 < budget_ms < float("inf"):
        raise InputError(f"--budget-ms: wanted a positive number of milliseconds a view, got {budget_ms:g}.")
    pixels = size[0] * size[1] / (front.size[0] * front.size[1])
    points = [point for point in front.points if point.factor <= max_factor]
    times = [point.steps_per_view * reference_ms * pixels for point in points]
    fitting = [(point, ms) for point, ms in zip(points, times, strict=True) if ms <= budget_ms]
    if not fitting:
        raise InputError(
            f"--budget-ms: wanted at least {min(times):.0f} ms a view, which the fastest setting takes here at"
            f" {size[0]}x{size[1]}, got {budget_ms:g}; give a smaller --size."
        )
    return max(fitting, key=lambda found: found[0].shown)


@dataclasses.dataclass(frozen=True)
class Choice:
    """The setting of a run with a budget."""

    point: FrontPoint
    file: Path
    record: dict[str, Any]
    """Contents of the file."""

    def save(self) -> None:
        """Writes the choice, when the run has been accepted: what is refused changes no file.

        Raises:
            StorageError: it cannot be written.
        """
        write_json(self.file, self.record)


def setting_for_run(
    budget_ms: float, path: str, size: tuple[int, int] | None, out: Path, *, overwrite: bool, reporter: Reporter
) -> Choice:
    """The setting of a run with a budget; a run that continues keeps the one that it started with.

    Times of a machine vary, and a run cannot change its setting on the way: `budget.json` in `out` holds the choice.

    Args:
        budget_ms: milliseconds a view, chunk in to novel view out.
        path: the capture, as `open_capture` takes it.
        size: (width, height) of the images; by default the capture's own.
        out: folder of the run.
        overwrite: choose anew.
        reporter: says what was chosen.

    Raises:
        InputError: see `choose` and `open_capture`; the capture lies in `out`, `out` holds a run that did not begin
            with this budget and size.
    """
    capture, folder = open_capture(path, size=size), RunFolder(out)
    capture.check_output_folder(out)
    asked = {"budget_ms": budget_ms, "size": [capture.width, capture.height]}
    # A larger image than the capture has would cost time and show nothing more; a procedural one has any size.
    stored = [open_capture(path)] if path.startswith("procedural:") else capture.frames
    max_factor = max(1.0, min(min(image.width / capture.width, image.height / capture.height) for image in stored))
    held = None if overwrite else _read_choice(folder.budget, asked)
    # Without a saved state, the choice may be that of another capture.
    if held is not None and (folder.has_state() or held.record.get("max_factor") == max_factor):
        return held
    if not overwrite and folder.has_state():  # its choice stays, so that it can continue
        fix = "repeat its options, or start anew with --overwrite"
        got = f"{budget_ms:g} at {capture.width}x{capture.height}"
        raise refusal("--budget-ms", wanted=f"what the run in {out} began with", got=got, fix=fix)
    reference_ms = reference_step_ms()
    point, ms = choose(load_front(), budget_ms, (capture.width, capture.height), reference_ms, max_factor=max_factor)
    reporter.say(f"--budget-ms {budget_ms:g}: {point.setting}, about {ms:.0f} ms a view on this machine")
    expected = {"expected_ms": round(ms, 1), "reference_ms": round(reference_ms, 2), "max_factor": max_factor}
    return Choice(point, folder.budget, asked | expected | {"point": dataclasses.asdict(point)})


def _read_choice(file: Path, asked: dict[str, Any]) -> Choice | None:
    """The choice that an earlier run with the same budget and size has made; None if there is none."""
    try:
        held = json.loads(file.read_text())
        return Choice(FrontPoint(**held["point"]), file, held) if asked.items() <= held.items() else None
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None


def reference_step_ms() -> float:
    """Milliseconds of the reference step on this machine: four small images into an empty cache with `tiny`."""
    session, chunk = Session(StreamSplat(preset("tiny")), load_params("tiny")), _reference_chunk()
    times = []
    for _ in range(NUM_REPEATS + 1):  # the first compiles
        session.cache = jax.block_until_ready(session.model.init_cache())
        since = time.perf_counter()
        session.feed(chunk)
        times.append(1e3 * (time.perf_counter() - since))
    return min(times[1:])


def _reference_chunk() -> Chunk:
    """Four views of noise, side by side: the time of a step depends on shapes alone."""
    width, height = REFERENCE_SIZE
    views = preset("tiny").stream.chunk_size
    rng = np.random.default_rng(0)
    viewmats = np.tile(np.eye(4, dtype=np.float32), (views, 1, 1))
    viewmats[:, 0, 3] = 0.1 * np.arange(views)
    K = np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]], np.float32)
    return Chunk(
        images=jnp.asarray(rng.uniform(size=(views, height, width, 3)), jnp.float32),
        viewmats=jnp.asarray(viewmats),
        Ks=jnp.tile(jnp.asarray(K), (views, 1, 1)),
        valid=jnp.ones(views, bool),
        near=jnp.asarray(0.5),
        far=jnp.asarray(10.0),
    )
