"""Split of a capture's frames into context views and targets, the order of the context, and index files of splits.

A split is a function of counts only, so it is reproducible:

interleaved   Of every `stride`-th frame, those at positions 4, 12, 20, ... are targets, and the first V others are
              context. Targets outside the span of the context are dropped, since they show unseen space.
paper         The protocol of StreamSplat's appendix: targets are uniform over the trajectory, including both ends, and
              the first V of the other frames are context.
scannet       The same with 64 targets: the trajectory is thinned to 1088 frames, and 8 anchors, spread over it, come
              first. Chunks take the context in that order. A trajectory of fewer frames is used whole; one without room
              for all targets and V other frames is refused.
index         Context and targets of an index file (`read_index`); chunks take the context in its order.

Counts that are not given fit the capture: see `choose_split`.
"""

import dataclasses
import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from ssplat_jax.core.errors import echo, refusal
from ssplat_jax.data.parsing import Fields, load_json

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

    @property
    def keeps_order(self) -> bool:
        """True if chunks take the context in its order, without interleaving."""
        return self.protocol in ("scannet", "index")

    def to_json(self) -> str:
        """Canonical JSON: equal splits give equal text."""
        return json.dumps(dataclasses.asdict(self), sort_keys=True, separators=(",", ":"))

    @property
    def sha256(self) -> str:
        """Digest that identifies the split in results."""
        return hashlib.sha256(self.to_json().encode()).hexdigest()


def choose_split(
    protocol: str, num_frames: int, stride: int | None, context: int | None, targets: int | None = None
) -> Split:
    """The split for the options of the command line.

    Args:
        protocol: "interleaved", "paper" or "scannet".
        num_frames: number of frames of the capture.
        stride: every `stride`-th frame is used. By default 1; without `context` and with `interleaved`, the number
            of frames divided by 73, rounded down, but at least 1: 73 frames or more are left.
        context: number of context views; by default 64, or as many as the targets leave.
        targets: for "paper", the number of targets (default 16, or a quarter of a short capture); for "scannet" too
            (default 64); for "interleaved", the largest number of targets that are kept, evenly spaced (default: all).
    """
    if protocol not in PROTOCOLS:
        raise refusal("protocol", wanted=" or ".join(PROTOCOLS), got=repr(protocol), fix="choose one of them")
    if stride is None:
        stride = max(1, num_frames // USUAL_FRAMES) if protocol == "interleaved" and context is None else 1
    _check_counts(stride=stride, **({} if targets is None else {"targets": targets}))
    taken = range(0, num_frames, stride)
    usual = {
        "interleaved": len(range(FIRST_TARGET, len(taken), TARGET_STEP)),
        "paper": min(PAPER_TARGETS, max(1, int(MAX_TARGET_SHARE * len(taken)))) if context is None else PAPER_TARGETS,
        "scannet": SCANNET_TARGETS,
    }
    num_targets = usual[protocol] if targets is None or protocol == "interleaved" else targets
    num_context = max(1, min(USUAL_CONTEXT, len(taken) - num_targets)) if context is None else context
    if protocol == "interleaved":
        if context is None and len(taken) < MIN_FRAMES:
            wanted, fix = f"at least {MIN_FRAMES} frames", "use a longer capture or a smaller --stride"
            raise refusal("eval", wanted=f"{wanted} for a target between context views", got=str(len(taken)), fix=fix)
        split = interleaved_split(num_frames, stride, num_context)
        places = _uniform(len(split.targets), len(split.targets) if targets is None else targets)
        return dataclasses.replace(split, targets=tuple(split.targets[p] for p in places))
    options = {}
    if protocol == "scannet":
        if len(taken) < num_targets + num_context:
            got, fix = f"{len(taken)} frames", "leave the scene out (null in an index file), or ask for fewer"
            wanted = f"{num_targets} targets and {num_context} other frames"
            raise refusal("scannet", wanted=wanted, got=got, fix=fix)
        options = {"anchors": SCANNET_ANCHORS, "thin_to": SCANNET_FRAMES}
    split = paper_split(len(taken), num_context, targets=num_targets, **options)
    context_frames, target_frames = (tuple(taken[p] for p in places) for places in (split.context, split.targets))
    return Split(protocol=protocol, context=context_frames, targets=target_frames)


def interleaved_split(num_frames: int, stride: int, context: int) -> Split:
    """The interleaved split: every 8th strided frame is a target, the first `context` others are context."""
    _check_counts(stride=stride, context=context)
    taken = range(0, num_frames, stride)
    at_target = set(taken[FIRST_TARGET::TARGET_STEP])
    chosen = _first([i for i in taken if i not in at_target], context, num_frames, f"with stride {stride}")
    targets = tuple(i for i in taken if i in at_target and chosen[0] < i < chosen[-1])
    if not targets:
        got = f"{context} (the first target is at position {FIRST_TARGET})"
        fix = f"ask for at least {FIRST_TARGET + 1}"
        raise refusal("context", wanted="enough views to span a target", got=got, fix=fix)
    return Split(protocol="interleaved", context=tuple(chosen), targets=targets)


def paper_split(
    num_frames: int, context: int, *, targets: int = PAPER_TARGETS, anchors: int = 0, thin_to: int | None = None
) -> Split:
    """The split of the paper's appendix; the defaults are those for DL3DV and RE10K.

    Args:
        num_frames: length of the trajectory.
        context: number of context views.
        targets: number of targets (ScanNet: 64), uniform over the trajectory.
        anchors: number of context views (ScanNet: 8) that are spread over the trajectory and come first.
        thin_to: number of frames to which the trajectory is thinned first (ScanNet: 1088); None keeps all.
    """
    _check_counts(context=context, targets=targets)
    trajectory = _uniform(num_frames, num_frames if thin_to is None else thin_to)
    chosen_targets = [trajectory[p] for p in _uniform(len(trajectory), targets)]
    pool = [i for i in trajectory if i not in set(chosen_targets)]
    anchored = [pool[p] for p in _uniform(len(pool), min(anchors, context))]
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


# -- order ------------------------------------------------------------------------------------------------------------

# A loop of 4,112 frames through the room, 0.03 % of the depth a frame, scores 23.4 dB with 8, 28.2 with 32; the
# 1,000 frames of redkitchen score the same with both.
MAX_INTERLEAVED_CHUNKS = 32
"""Largest number of chunks interleaved at a time: with chunks of 4, 128 frames or about four seconds of video."""
NUM_MEASURED_STEPS = 31  # steps between cameras by whose median a block is measured: about a second of video


def interleave(centers: Float64[np.ndarray, "n 3"], indices: Sequence[int], chunk_size: int, step: float) -> list[int]:
    """Orders the frames of slow video so that consecutive views of a chunk are about `step` apart.

    Frames of hand-held video are often 0.4 % of the depth apart, and four consecutive ones have too little parallax to
    determine depth. Interleaved over `s` chunks, frames 0, s, 2s, 3s form the first chunk, 1, s + 1, ... the second,
    and so on: every frame is used, and none is delayed by more than a block of `chunk_size * s` frames. The order
    depends on poses only, so it is known before an image is read.

    Returns:
        A permutation of `indices`, whose cameras are at `centers`. Blocks of `chunk_size * s` frames are interleaved
        one after the other, with s from 1 to `MAX_INTERLEAVED_CHUNKS`. Frames that are `step` apart already and frames
        that do not move keep their order.
    """
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=-1)
    order: list[int] = []
    while len(order) < len(indices):
        first = len(order)
        ahead = steps[first : first + NUM_MEASURED_STEPS]
        typical = float(np.median(ahead)) if ahead.size else 0.0
        num_chunks = int(np.clip(round(step / typical), 1, MAX_INTERLEAVED_CHUNKS)) if typical > 0 else 1
        block = list(indices[first : first + chunk_size * num_chunks])
        num_chunks = -(-len(block) // chunk_size)
        for chunk in range(num_chunks):
            order += block[chunk::num_chunks]
    return order


# -- index files ------------------------------------------------------------------------------------------------------

Index = dict[str, Split | None]  # the split of each scene; None for a scene that is left out


def read_index(path: Path) -> tuple[Index, tuple[str, ...]]:
    """Reads an index file: the context and target frames of scenes, as DepthSplat, ReSplat and pixelSplat publish them.

        {"scene": {"context": [0, 8, 16], "target": [4, 12]}, "a scene that is left out": null}

    Other fields (pixelSplat's `overlap`, for example) are not used. Indices of videos list every frame as a target. A
    target that is streamed too is not scored, and a note counts them.

    Returns:
        The splits of its scenes, and notes for the user.
    """
    scenes = load_json(path)
    if not scenes:
        raise refusal(str(path), wanted="a scene at least", got="none", fix='write {"scene": {"context", "target"}}')
    index: Index = {}
    num_listed = num_kept = 0
    for name, fields in scenes.items():
        index[name] = None
        if fields is not None:
            where = f"{path}: {echo(name)}"
            context, listed = (_frame_numbers(fields, where, kind) for kind in ("context", "target"))
            targets = tuple(i for i in listed if i not in set(context))
            if not targets:
                got, fix = echo(list(listed)), "list a frame that is not in context"
                raise refusal(f"{where}.target", wanted="a frame that is not streamed", got=got, fix=fix)
            index[name] = Split(protocol="index", context=context, targets=targets)
            num_listed, num_kept = num_listed + len(listed), num_kept + len(targets)
    note = f"{path}: {num_listed - num_kept} of {num_listed} targets are context frames too; they are not scored."
    return index, (note,) if num_kept < num_listed else ()


def _frame_numbers(fields: Any, where: str, name: str) -> tuple[int, ...]:
    """The frame numbers of one list of a scene."""
    numbers = Fields(fields, where).entries(name)
    if not all(type(i) is int and i >= 0 for i in numbers) or len(set(numbers)) < len(numbers):
        fix = "list the numbers of frames, from 0"
        raise refusal(f"{where}.{name}", wanted="frame numbers, each once", got=echo(numbers), fix=fix)
    return tuple(numbers)


def split_of_scene(index: Index, scene: str, num_frames: int) -> Split:
    """The split of one scene of an index for a capture of `num_frames`."""
    if scene not in index:
        got, fix = f"{len(index)} others, such as {echo(next(iter(index), ''))}", "name one of them with --scene"
        raise refusal("--index", wanted=f"the scene {echo(scene)}", got=got, fix=fix)
    split = index[scene]
    if split is None:
        got, fix = "null: the index leaves the scene out", "score another scene"
        raise refusal("--index", wanted=f"frames for {echo(scene)}", got=got, fix=fix)
    last = max(*split.context, *split.targets)
    if last >= num_frames:
        fix = "use the capture that the index was made for"
        raise refusal("--index", wanted=f"frame {last}", got=f"a capture of {num_frames} frames", fix=fix)
    return split


def index_to_json(index: Index) -> dict[str, Any]:
    """An index as plain JSON types; the inverse is `read_index`, but for the name of the protocol."""
    return {
        name: None if split is None else {"context": list(split.context), "target": list(split.targets)}
        for name, split in index.items()
    }
