"""Captures that a training learns from, beside procedural scenes.

Every 8th frame of a capture from the 5th on, a target of the interleaved protocol, is held out: samples show it neither
as context nor as target, and `ssplat eval` scores it.
"""

import dataclasses
import functools
import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ssplat_jax.config import StreamConfig
from ssplat_jax.core.errors import refusal
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.open_capture import is_capture, open_capture
from ssplat_jax.data.split import FIRST_TARGET, TARGET_STEP
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.model.streamsplat import StreamSplat

ESTIMATION_SIZE, MAX_ESTIMATION_FRAMES = (320, 240), 64
"""Width and height, and number, of the images from which scale, near and far of a capture are estimated."""


class CaptureGroup(NamedTuple):
    """Captures that together get a share of the training steps."""

    name: str
    share: float
    captures: tuple[Capture, ...]


@dataclasses.dataclass(frozen=True, eq=False)
class CaptureMix:
    """Captures to learn from. Steps that no group gets are procedural."""

    groups: tuple[CaptureGroup, ...]
    config: StreamConfig

    @property
    def share(self) -> float:
        """Share of the steps of all groups together."""
        return sum(group.share for group in self.groups)

    @property
    def captures(self) -> list[Capture]:
        """The captures of all groups."""
        return [capture for group in self.groups for capture in group.captures]

    @property
    def is_masked(self) -> bool:
        """True if some capture has masks; samples of all then have some, since they are stacked."""
        return any(capture.is_masked for capture in self.captures)

    def draw(self, rng: np.random.Generator) -> Capture | None:
        """The capture of a step, each group with its share; None for a procedural step."""
        place = rng.uniform()
        for group in self.groups:
            if place < group.share:
                return group.captures[rng.integers(len(group.captures))]
            place -= group.share
        return None

    def describe(self) -> list:
        """Facts that identify the captures in a run, as JSON types."""
        # Sizes of files stand for contents: a data set may be too large to be read at every start.
        size_of = lambda path: path and f"{path.name} {path.stat().st_size}"  # noqa: E731

        def digests(capture: Capture) -> tuple[str, str, str]:
            files = [(size_of(frame.path), size_of(frame.depth_path), frame.depth_unit) for frame in capture.frames]
            digest = hashlib.sha256(repr(files).encode()).hexdigest()[:12]
            return capture.name, capture.digest(range(len(capture))), digest

        return [(group.name, group.share, [digests(capture) for capture in group.captures]) for group in self.groups]

    @functools.lru_cache(maxsize=1024)  # noqa: B019 - a mix lives as long as its training
    def frame_of(self, capture: Capture) -> StreamFrame:
        """Scale, near and far of a capture, estimated once from the frames that may be learned from."""
        learned = learned_frames(capture)
        places = np.linspace(0, len(learned) - 1, min(len(learned), MAX_ESTIMATION_FRAMES)).round().astype(int)
        return capture.stream_frame(self.config, [learned[i] for i in places])


@dataclasses.dataclass(frozen=True, eq=False)
class TrainingStart:
    """Inputs from which the samples of a phase are made."""

    model: StreamSplat
    params: dict  # of all stages, as the training began
    mix: CaptureMix | None
    seed: int  # of the recipe
    num_steps: int  # of the recipe
    say: Callable[[str], None]  # called with messages while scenes are prepared


def open_mix(folders: Sequence[Path], shares: Sequence[float], config: StreamConfig, total: float = 0.5) -> CaptureMix:
    """Opens captures, or folders of captures, each with its share of the steps; by default equal ones of `total`.

    Raises:
        InputError: shares do not fit, or a folder holds no capture.
    """
    shares = list(shares) or [total / len(folders)] * len(folders)
    if len(shares) != len(folders) or not all(share > 0 for share in shares) or sum(shares) > 1 + 1e-9:
        wanted = f"{len(folders)} numbers above 0 that add up to at most 1, one for each of --captures"
        raise refusal("--shares", wanted=wanted, got=" ".join(map(str, shares)), fix="give one share a folder")
    groups = []
    for folder, share in zip(folders, shares, strict=True):
        captures = tuple(open_capture(path, size=ESTIMATION_SIZE) for path in captures_in(folder))
        groups.append(CaptureGroup(folder.name, float(share), captures))
    return CaptureMix(tuple(groups), config)


def captures_in(folder: Path) -> list[Path]:
    """Paths of the captures at `folder`: itself, or else those in it."""
    if is_capture(folder) or not folder.is_dir():
        return [folder]
    # Where no reader knows any, `open_capture` refuses the folder with a reason.
    return sorted(path for path in folder.iterdir() if path.is_dir() and is_capture(path)) or [folder]


def learned_frames(capture: Capture) -> list[int]:
    """Frames that may be learned from."""
    return [i for i in range(len(capture)) if i % TARGET_STEP != FIRST_TARGET]
