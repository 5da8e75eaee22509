"""Which frames are context and which are targets. Pure functions of counts, so that a result can be repeated anywhere.

interleaved   of the frames taken with a stride, those at positions 4, 12, 20, ... are targets and the first V others
              are context; targets outside the context's span are left out, since nothing can be known there.
paper         StreamSplat's appendix: targets uniform over the trajectory, end points inclusive; context is the first V
              of the rest. ScanNet's runs thin the trajectory to 1088 frames and put 8 anchors, spread over the rest,
              in front.
"""

import dataclasses
import hashlib
import json

import numpy as np

from ssplat_jax.errors import refusal

FIRST_TARGET, TARGET_STEP = 4, 8  # positions of the interleaved targets


@dataclasses.dataclass(frozen=True)
class Split:
    """Frame numbers of a run, disjoint by construction."""

    protocol: str
    context: tuple[int, ...]  # in the order in which they are streamed
    targets: tuple[int, ...]

    def __post_init__(self) -> None:
        used = self.context + self.targets
        if len(set(used)) != len(used):
            raise ValueError("a frame stands twice in the split, as context, as target or as both.")

    def to_json(self) -> str:
        """Canonical JSON: the same split gives the same text."""
        return json.dumps(dataclasses.asdict(self), sort_keys=True, separators=(",", ":"))

    @property
    def sha256(self) -> str:
        """Names the split in results."""
        return hashlib.sha256(self.to_json().encode()).hexdigest()


def interleaved(num_frames: int, stride: int, context: int) -> Split:
    """Every 8th frame of those taken with `stride` is a target, from position 4 on; the first `context` others stream.

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
        got = f"{context} (the first target stands at position {FIRST_TARGET})"
        fix = f"ask for at least {FIRST_TARGET + 1}"
        raise refusal("context", wanted="enough views to span a target", got=got, fix=fix)
    return Split(protocol="interleaved", context=tuple(chosen), targets=tuple(targets))


def paper(num_frames: int, context: int, *, targets: int = 16, anchors: int = 0, thin_to: int | None = None) -> Split:
    """The paper's appendix: `targets` uniform frames, then the first `context` of the rest, `anchors` of them up front.

    DL3DV and RE10K: the defaults. ScanNet: targets=64, anchors=8, thin_to=1088.

    Raises:
        InputError: the trajectory is too short.
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
    """Up to `count` different positions in [0, length), evenly spread, both ends included."""
    return np.unique(np.linspace(0, max(length - 1, 0), count).round().astype(int)).tolist() if length else []


def _first(pool: list[int], count: int, num_frames: int, how: str) -> list[int]:
    if len(pool) < count:
        got = f"{len(pool)} of {num_frames} frames {how}"
        raise refusal("context", wanted=f"{count} views", got=got, fix="ask for fewer views or a smaller stride")
    return pool[:count]


def _check_counts(**counts: int) -> None:
    for name, count in counts.items():
        if count < 1:
            raise refusal(name, wanted="at least 1", got=str(count), fix="ask for a positive number")


def choose_split(protocol: str, num_frames: int, stride: int, context: int, targets: int | None) -> Split:
    """The split that the command line's words describe.

    `targets` is the number of targets of the paper's protocol (default 16), over every `stride`-th frame; of the
    interleaved one it is the most that are kept, evenly spread.

    Raises:
        InputError: no such protocol, or too few frames.
    """
    if protocol == "interleaved":
        split = interleaved(num_frames, stride, context)
        if targets is None:
            return split
        _check_counts(targets=targets)
        kept = tuple(split.targets[p] for p in _uniform(len(split.targets), targets))
        return dataclasses.replace(split, targets=kept)
    if protocol != "paper":
        raise refusal("protocol", wanted="interleaved or paper", got=repr(protocol), fix="choose one of them")
    _check_counts(stride=stride)
    taken = range(0, num_frames, stride)
    split = paper(len(taken), context, targets=16 if targets is None else targets)
    at = lambda positions: tuple(taken[p] for p in positions)  # noqa: E731
    return Split(protocol="paper", context=at(split.context), targets=at(split.targets))
