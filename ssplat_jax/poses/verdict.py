"""Verdict on a reconstruction in plain words: what was registered, how well, and what to do about the rest."""

import dataclasses
import itertools
from collections.abc import Sequence

from ssplat_jax.core.errors import InputError

MIN_REGISTERED = 4  # images: one chunk
MIN_SHARE = 0.25  # of the images; fewer registered ones are no result
GOOD_SHARE = 0.9  # of the images; below it the verdict says what to do
GOOD_ERROR = 1.5  # pixels: a larger median reprojection error is reported
MIN_PART = 3  # images of a part that is worth naming
MAX_RANGES = 6  # ranges of images that a line names


@dataclasses.dataclass(frozen=True)
class Findings:
    """Contents of a reconstruction."""

    names: tuple[str, ...]  # of all images, in order
    parts: tuple[tuple[str, ...], ...]  # names of the registered images of each model, the largest first
    reprojection_error: float  # pixels, median over the points of the largest model
    num_points: int  # of the largest model


def verdict(found: Findings) -> list[str]:
    """Sentences about a reconstruction, the most important first."""
    registered = set(found.parts[0])
    lines = [
        f"registered {len(registered)} of {len(found.names)} images, median reprojection error"
        f" {found.reprojection_error:.1f} px, {found.num_points:,} points"
    ]
    others = _other_parts(found)
    if others:
        number = {1: "one part", 2: "two parts", 3: "three parts"}.get(len(others), f"{len(others)} parts")
        shown = "; ".join(f"{len(part)} images ({ranges(found.names, part)})" for part in others[:MAX_RANGES])
        lines.append(
            f"{number} not connected to the rest: {shown}. Take more pictures of the passage between them, or keep"
            " the parts apart."
        )
    placed = registered.union(*others)
    missing = [name for name in found.names if name not in placed]
    if missing:
        lines.append(f"without a pose: {ranges(found.names, missing)}")
    if len(registered) < GOOD_SHARE * len(found.names):
        lines.append(
            "to register more: move slowly and sideways, let neighboring pictures overlap by two thirds, keep textured"
            " surfaces in sight; blank walls, reflections and turning on the spot give no poses"
        )
    if found.reprojection_error > GOOD_ERROR:
        lines.append(
            "the error is large: moving things, motion blur, a rolling shutter, or a fish-eye lens (then: --fisheye)"
        )
    return lines


def check_registered(found: Findings, source: str) -> None:
    """Checks that enough images are registered for a scene.

    Raises:
        InputError: they are not.
    """
    num, total = len(found.parts[0]) if found.parts else 0, len(found.names)
    if num < max(MIN_REGISTERED, MIN_SHARE * total):
        raise InputError(
            f"{source}: wanted poses of most images, got {num} of {total}; take pictures of a scene that stands still,"
            " with two thirds of overlap between neighbors, moving sideways past textured surfaces, not turning on the"
            " spot."
        )


def ranges(names: Sequence[str], some: Sequence[str]) -> str:
    """Names of some images, those that follow each other joined: "1.jpg to 4.jpg, 9.jpg"."""
    places = sorted(names.index(name) for name in some)
    runs = [[i for _, i in run] for _, run in itertools.groupby(enumerate(places), lambda pair: pair[1] - pair[0])]
    shown = [names[run[0]] if len(run) == 1 else f"{names[run[0]]} to {names[run[-1]]}" for run in runs]
    return ", ".join(shown[:MAX_RANGES]) + (f" and {len(shown) - MAX_RANGES} more" if len(shown) > MAX_RANGES else "")


def _other_parts(found: Findings) -> list[list[str]]:
    """Images of the smaller models that no larger one holds, without models of a few images."""
    placed, others = set(found.parts[0]), []
    for part in found.parts[1:]:
        fresh = [name for name in part if name not in placed]
        if len(fresh) >= MIN_PART:
            others.append(fresh)
            placed.update(fresh)
    return others
