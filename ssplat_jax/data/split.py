"""Split of a capture's frames into context views and targets; a function of counts only, so splits are reproducible.

interleaved   Of every `stride`-th frame, those at positions 4, 12, 20, ... are targets, and the first V others are
              context. Targets outside the span of the context are dropped, since they show unseen space.
paper         The protocol of StreamSplat's appendix: targets are uniform over the trajectory, including both ends, and
              the first V of the other frames are context.
scannet       The same with 64 targets: the trajectory is thinned to 1088 frames, and 8 anchors, spread over it, come
              first. Chunks take the context in that order. A trajectory of fewer frames is used whole; one without room
              for all targets and V other frames is refused.
index         Context and targets of an index file (`index_files.py`); chunks take the context in its order.

Counts that are not given fit the capture: see `choose_split`.
"""

import dataclasses
import hashlib
import json

import numpy as np

from ssplat_jax.core.errors import refusal

FIRST_TARGET, TARGET_STEP = 4, 8  # first position and spacing of the interleaved targets
USUAL_CONTEXT = 64  # context views where none are given, if there are as many
USUAL_FRAMES = 73  # those context views and the interleaved targets between them
PAPER_TARGETS = 16
MIN_FRAMES = FIRST_TARGET + 2  # of a split without a given context: a target between context views
MAX_TARGET_SHARE = 0.25  # of the frames that become targets of `paper` where their number is not given
SCANNET_FRAMES, SCANNET_TARGETS, SCANNET_ANCHORS = 1088, 64, 8
PROTOCOLS = ("interleaved", "paper", "scannet")


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

    @property
    def keeps_order(self) -> bool:
        """True if chunks take the context in its order, without interleaving."""
        return self.protocol in ("scannet", "index")

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


def scannet_split(num_frames: int, context: int, targets: int = SCANNET_TARGETS) -> Split:
    """Returns the split of the paper's appendix for ScanNet; `protocol` is "scannet".

    Raises:
        InputError: the trajectory has no room for that many targets and context views.
    """
    if num_frames < targets + context:
        got, fix = f"{num_frames} frames", "leave the scene out (null in an index file), or ask for fewer"
        raise refusal("scannet", wanted=f"{targets} targets and {context} other frames", got=got, fix=fix)
    split = paper_split(
        num_frames, context, targets=targets, anchors=min(SCANNET_ANCHORS, context), thin_to=SCANNET_FRAMES
    )
    return dataclasses.replace(split, protocol="scannet")


def choose_split(
    protocol: str, num_frames: int, stride: int | None, context: int | None, targets: int | None = None
) -> Split:
    """Returns the split for the options of the command line.

    Args:
        protocol: "interleaved", "paper" or "scannet".
        num_frames: number of frames of the capture.
        stride: every `stride`-th frame is used. By default 1; without `context` and with `interleaved`, the number
            of frames divided by 73, rounded down, but at least 1: 73 frames or more are left.
        context: number of context views; by default 64, or as many as there are.
        targets: for "paper", the number of targets (default 16, or a quarter of a short capture); for "scannet" too
            (default 64); for "interleaved", the largest number of targets that are kept, evenly spaced (default: all).

    Returns:
        The split.

    Raises:
        InputError: the protocol is unknown, or there are too few frames.
    """
    if protocol not in PROTOCOLS:
        raise refusal("protocol", wanted=" or ".join(PROTOCOLS), got=repr(protocol), fix="choose one of them")
    if stride is None:
        stride = max(1, num_frames // USUAL_FRAMES) if protocol == "interleaved" and context is None else 1
    _check_counts(stride=stride)
    taken = range(0, num_frames, stride)
    if protocol == "interleaved":
        return _choose_interleaved(num_frames, stride, context, targets)
    if protocol == "scannet":
        num_targets = SCANNET_TARGETS if targets is None else targets
        split = scannet_split(len(taken), _usual_context(len(taken), num_targets, context), num_targets)
    else:
        few = max(1, int(MAX_TARGET_SHARE * len(taken))) if context is None else PAPER_TARGETS
        num_targets = min(PAPER_TARGETS, few) if targets is None else targets
        split = paper_split(len(taken), _usual_context(len(taken), num_targets, context), targets=num_targets)
    at = lambda positions: tuple(taken[p] for p in positions)  # noqa: E731
    return dataclasses.replace(split, context=at(split.context), targets=at(split.targets))


def _usual_context(num_frames: int, targets: int, context: int | None) -> int:
    """The number of context views: as asked for, or the usual one, or as many as the targets leave."""
    return max(1, min(USUAL_CONTEXT, num_frames - targets)) if context is None else context


def _choose_interleaved(num_frames: int, stride: int, context: int | None, targets: int | None) -> Split:
    """The interleaved split, with at most `targets` targets."""
    if context is None:
        num_taken = len(range(0, num_frames, stride))
        num_targets = len(range(FIRST_TARGET, num_taken, TARGET_STEP))
        context = _usual_context(num_taken, num_targets, None)
        if num_taken < MIN_FRAMES:
            wanted = f"at least {MIN_FRAMES} frames for a target between context views"
            raise refusal("eval", wanted=wanted, got=f"{num_taken}", fix="use a longer capture or a smaller --stride")
    split = interleaved_split(num_frames, stride, context)
    if targets is None:
        return split
    _check_counts(targets=targets)
    kept = tuple(split.targets[p] for p in _uniform(len(split.targets), targets))
    return dataclasses.replace(split, targets=kept)
