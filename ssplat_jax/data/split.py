"""Split of a capture's frames into context views and targets; a function of counts only, so splits are reproducible.

interleaved   Of every `stride`-th frame, those at positions 4, 12, 20, ... are targets, and the first V others are
              context. Targets outside the span of the context are dropped, since they show unseen space.
paper         The protocol of StreamSplat's appendix: targets are uniform over the trajectory, including both ends, and
              the first V of the other frames are context. On ScanNet the trajectory is thinned to 1088 frames, and 8
              anchors, spread over it, come first.
"""

import dataclasses
import hashlib
import json

import numpy as np

from ssplat_jax.errors import refusal

FIRST_TARGET, TARGET_STEP = 4, 8  # first position and spacing of the interleaved targets


@dataclasses.dataclass(frozen=True)
class Split:
    """Context and target frames of a run; a frame occurs only once."""

    protocol: str
    context: tuple[int, ...]  # in the order of streaming
    targets: tuple[int, ...]

    def __post_init__(self) -> None:
        used = self.context + self.targets
        if len(set(used)) != len(used):
            raise ValueError("a frame occurs twice in the split.")

    def to_json(self) -> str:
        """Returns canonical JSON: equal splits give equal text."""
        return json.dumps(dataclasses.asdict(self), sort_keys=True, separators=(",", ":"))

    @property
    def sha256(self) -> str:
        """Digest that identifies the split in results."""
        return hashlib.sha256(self.to_json().encode()).hexdigest()


def interleaved_split(num_frames: int, stride: int, context: int) -> Split:
    """Returns the interleaved split: every 8th strided frame is a target, the first `context` others are context.

    Raises:
        InputError: too few frames for `context` views and one target between them.
    """
    _check_counts(stride=stride, context=context)
    taken = range(0, num_frames, stride)
    is_target = [p % TARGET_STEP == FIRST_TARGET for p in range(len(taken))]
    pool = [i for i, target in zip(taken, is_target, strict=True) if not target]
    chosen = _first(pool, context, num_frames, f"with stride {stride}")
    targets = [i for i, target in zip(taken, is_target, strict=True) if target and chosen[0] < i < chosen[-1]]
    if not targets:
        got = f"{context} (the first target is at position {FIRST_TARGET})"
        fix = f"ask for at least {FIRST_TARGET + 1}"
        raise refusal("context", wanted="enough views to span a target", got=got, fix=fix)
    return Split(protocol="interleaved", context=tuple(chosen), targets=tuple(targets))


def paper_split(
    num_frames: int, context: int, *, targets: int = 16, anchors: int = 0, thin_to: int | None = None
) -> Split:
    """Returns the split of the paper's appendix; the defaults are those for DL3DV and RE10K.

    Args:
        num_frames: length of the trajectory.
        context: number of context views.
        targets: number of targets (ScanNet: 64), uniform over the trajectory.
        anchors: number of context views (ScanNet: 8) that are spread over the trajectory and come first.
        thin_to: number of frames to which the trajectory is thinned first (ScanNet: 1088); None keeps all.

    Returns:
        The split.

    Raises:
        InputError: the trajectory is too short, or a count is not positive.
    """
    _check_counts(context=context, targets=targets)
    if not 0 <= anchors <= context:
        raise refusal("anchors", wanted=f"0 to {context} (the context views)", got=str(anchors), fix="ask for fewer")
    trajectory = list(range(num_frames))
    if thin_to is not None:
        _check_counts(thin_to=thin_to)
        trajectory = [trajectory[p] for p in _uniform(num_frames, thin_to)]
    chosen_targets = [trajectory[p] for p in _uniform(len(trajectory), targets)]
    pool = [i for i in trajectory if i not in set(chosen_targets)]
    anchored = [pool[p] for p in _uniform(len(pool), anchors)]
    rest = [i for i in pool if i not in set(anchored)]
    chosen = anchored + _first(rest, context - len(anchored), num_frames, f"without {len(chosen_targets)} targets")
    return Split(protocol="paper", context=tuple(chosen), targets=tuple(chosen_targets))


def _uniform(length: int, count: int) -> list[int]:
    """Up to `count` distinct, evenly spaced positions in [0, length), including both ends."""
    return np.unique(np.linspace(0, max(length - 1, 0), count).round().astype(int)).tolist() if length else []


def _first(pool: list[int], count: int, num_frames: int, how: str) -> list[int]:
    """The first `count` frames of `pool`; too small a pool is refused."""
    if len(pool) < count:
        got = f"{len(pool)} of {num_frames} frames {how}"
        raise refusal("context", wanted=f"{count} views", got=got, fix="ask for fewer views or a smaller stride")
    return pool[:count]


def _check_counts(**counts: int) -> None:
    for name, count in counts.items():
        if count < 1:
            raise refusal(name, wanted="at least 1", got=str(count), fix="ask for a positive number")


def choose_split(protocol: str, num_frames: int, stride: int, context: int, targets: int | None) -> Split:
    """Returns the split for the options of the command line.

    Args:
        protocol: "interleaved" or "paper".
        num_frames: number of frames of the capture.
        stride: every `stride`-th frame is used.
        context: number of context views.
        targets: for "paper", the number of targets (default 16); for "interleaved", the largest number of targets
            that are kept, evenly spaced (default: all).

    Returns:
        The split.

    Raises:
        InputError: the protocol is unknown, or there are too few frames.
    """
    if protocol == "interleaved":
        split = interleaved_split(num_frames, stride, context)
        if targets is None:
            return split
        _check_counts(targets=targets)
        kept = tuple(split.targets[p] for p in _uniform(len(split.targets), targets))
        return dataclasses.replace(split, targets=kept)
    if protocol != "paper":
        raise refusal("protocol", wanted="interleaved or paper", got=repr(protocol), fix="choose one of them")
    _check_counts(stride=stride)
    taken = range(0, num_frames, stride)
    split = paper_split(len(taken), context, targets=16 if targets is None else targets)
    at = lambda positions: tuple(taken[p] for p in positions)  # noqa: E731
    return Split(protocol="paper", context=at(split.context), targets=at(split.targets))
