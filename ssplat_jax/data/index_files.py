"""Index files: the context and target frames of scenes, as DepthSplat, ReSplat and pixelSplat publish them.

    {"scene": {"context": [0, 8, 16], "target": [4, 12]}, "a scene that is left out": null}

Files that are read may hold other fields beside the two lists (pixelSplat's `overlap`, for example); they are not used.
Indices of videos list every frame as a target. A target that is streamed too is not scored, and a note counts them.
"""

from pathlib import Path
from typing import Any

from ssplat_jax.core.errors import echo, refusal
from ssplat_jax.data.readers.strict_json import load_json
from ssplat_jax.data.split import Split

Index = dict[str, Split | None]
"""The split of each scene; None for a scene that is left out."""

NUM_NAMED = 3
"""Scenes of an index that a message names."""


def read_index(path: Path) -> tuple[Index, tuple[str, ...]]:
    """Reads an index file.

    Returns:
        The splits of its scenes, and notes for the user.

    Raises:
        InputError: the file is missing or is no index; the message names the scene and the field.
    """
    scenes = load_json(path)
    if not scenes:
        raise refusal(str(path), wanted="a scene at least", got="none", fix='write {"scene": {"context", "target"}}')
    index: Index = {name: _read_scene(fields, f"{path}: {echo(name)}") for name, fields in scenes.items()}
    num_listed = sum(len(scenes[name]["target"]) for name, split in index.items() if split is not None)
    num_kept = sum(len(split.targets) for split in index.values() if split is not None)
    note = f"{path}: {num_listed - num_kept} of {num_listed} targets are context frames too; they are not scored."
    return index, (note,) if num_kept < num_listed else ()


def _read_scene(fields: Any, where: str) -> Split | None:
    if fields is None:
        return None
    if not isinstance(fields, dict):
        fix = "give the lists context and target"
        raise refusal(where, wanted="an object or null", got=echo(fields), fix=fix)
    lists = {}
    for name in ("context", "target"):
        value, fix = fields.get(name), "list the numbers of frames, from 0"
        if not isinstance(value, list) or not value or not all(type(i) is int and i >= 0 for i in value):
            raise refusal(f"{where}.{name}", wanted="frame numbers", got=echo(value), fix=fix)
        if len(set(value)) != len(value):
            raise refusal(f"{where}.{name}", wanted="every frame once", got=echo(value), fix="drop the repeated ones")
        lists[name] = tuple(value)
    targets = tuple(i for i in lists["target"] if i not in set(lists["context"]))
    if not targets:
        fix = "list a frame that is not in context"
        raise refusal(f"{where}.target", wanted="a frame that is not streamed", got=echo(lists["target"]), fix=fix)
    return Split(protocol="index", context=lists["context"], targets=targets)


def split_of_scene(index: Index, scene: str, num_frames: int) -> Split:
    """The split of one scene of an index.

    Raises:
        InputError: the index does not hold the scene or leaves it out, or the capture has no frame of that number.
    """
    if scene not in index:
        named = ", ".join(list(index)[:NUM_NAMED]) + (" ..." if len(index) > NUM_NAMED else "")
        fix = "name one of them with --scene"
        raise refusal("--index", wanted=f"the scene {echo(scene)}", got=f"{len(index)} others ({named})", fix=fix)
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
