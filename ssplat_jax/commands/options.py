"""Options and helpers that several commands share. Nothing here imports JAX before a command runs."""

import dataclasses
import inspect
import json
import math
import re
from collections.abc import Callable, Iterable
from importlib.metadata import entry_points
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_type_hints

import tyro

from ssplat_jax.config import QUALITIES, StreamConfig, preset
from ssplat_jax.core.errors import InputError

CapturePath = Annotated[
    str,
    tyro.conf.Positional,
    tyro.conf.arg(
        metavar="CAPTURE", help="Folder of a posed capture (formats: ssplat inspect --help), or procedural:NAME."
    ),
]
AxesOption = Annotated[
    Literal["opencv", "opengl"] | None,
    tyro.conf.arg(help="Axes of the cameras in the capture's files, if not those of its format (see ssplat inspect)."),
]
PosesOption = Annotated[
    Literal["camera-to-world", "world-to-camera"] | None,
    tyro.conf.arg(help="Direction of the poses in the capture's files, if not that of its format."),
]
DepthOption = Annotated[
    Literal["on", "off"] | None,
    tyro.conf.arg(
        help="Stream depth maps too, as a sensor's; on where the capture has some, off for procedural scenes, whose are"
        " exact."
    ),
]
WeightsOption = Annotated[str, tyro.conf.arg(help="Preset with shipped weights, or a weights file.")]
ConfigChanges = Annotated[tuple[str, ...], tyro.conf.arg(help="Changes to the configuration, as field=value.")]
QualityOption = Annotated[
    Literal["fast", "balanced", "accurate", "best"],
    tyro.conf.arg(
        help="Accuracy against time: fast and balanced stream smaller images; best refines the scene after the stream."
    ),
]
QuietOption = Annotated[bool, tyro.conf.arg(help="Print only the closing line.")]


def capture_path(path: str, axes: str | None, poses: str | None, depth: str | None = None) -> str:
    """Path of a capture as `open_capture` takes it, with the options --axes, --poses and --depth."""
    from ssplat_jax.data.posed_image import with_options

    return with_options(path, axes=axes, poses=poses, depth=depth)


def parse_size(text: str | None) -> tuple[int, int] | None:
    """(width, height) from "WxH".

    Raises:
        InputError: the text has another form.
    """
    if text is None:
        return None
    found = re.fullmatch(r"(\d{1,9})x(\d{1,9})", text)
    if not found:
        raise InputError(f"--size: wanted WIDTHxHEIGHT in pixels, got {text!r}; for example --size 320x240.")
    return int(found[1]), int(found[2])


def apply_changes(config: StreamConfig, changes: tuple[str, ...]) -> StreamConfig:
    """`config` with changes given as "field=value"; a value is JSON, or else plain text.

    Raises:
        InputError: no such field, a value that the field does not take, or two values of one field, as by `voxel_size`
            and `memory.voxel_size`, or by --set and an option such as --causal.
    """
    parsed, given = {}, {}
    for change in changes:
        name, equals, text = change.partition("=")
        if not equals:
            raise InputError(f"--set: wanted field=value, got {change!r}; for example --set voxel_size=0.02.")
        try:
            value = json.loads(text)
        except json.JSONDecodeError:
            value = math.inf if text == "inf" else text
        value = tuple(value) if isinstance(value, list) else value
        held = config.preset if name == "preset" else config.get(name)
        # A field that takes a word or a number (scene_scale) holds a word by default; the configuration checks both.
        if not isinstance(held, str) and not (value is None and _admits_none(config, name)):
            value = float(value) if isinstance(held, float) and type(value) is int else value
            if held is not None and type(value) is not type(held):
                raise InputError(f"--set {name}: wanted a value like {held!r}, got {text!r}.")
        place = name if name in ("preset", *config.groups()) else ".".join(config.find(name))
        before, first = given.setdefault(place, (value, change))
        if before != value:
            raise InputError(
                f"--set: wanted one value of {place}, got {first} and {change}: drop one; --causal and"
                f" --watch set stream.causal, --online-refine sets stream.steps_per_chunk."
            )
        parsed[name] = value
    return config.replace(**parsed)


def _admits_none(config: StreamConfig, name: str) -> bool:
    """True if None is a value of the field."""
    group, field = config.find(name)
    return type(None) in get_args(get_type_hints(type(getattr(config, group)))[field])


def load_model(weights: str, changes: tuple[str, ...]):
    """(model, params) of a preset's shipped weights, or of a weights file.

    Args:
        weights: name of a preset, or path of a weights file.
        changes: changes to the configuration, as "field=value".

    Raises:
        InputError: no such weights, a bad change, or a change that does not fit the weights.
    """
    from ssplat_jax.config import PRESETS
    from ssplat_jax.model.streamsplat import StreamSplat
    from ssplat_jax.storage.weights import check_params, load_params, load_weights

    if weights in PRESETS:
        config, params = preset(weights), load_params(weights)
    elif Path(weights).is_file():
        params, config = load_weights(Path(weights))
    else:
        params, config = load_params(weights), preset("tiny")
    changed = apply_changes(config, changes)
    if changed != config:
        check_params(params, changed, weights)
    return StreamSplat(changed), params


def check_steps(steps: int, flag: str) -> None:
    """Refuses a negative number of steps, the value of `flag`.

    Raises:
        InputError: `steps` is negative.
    """
    if steps < 0:
        raise InputError(f"{flag}: wanted a number of steps of at least 0, got {steps}.")


@dataclasses.dataclass(frozen=True)
class StreamOptions:
    """Options of the commands that stream a capture."""

    capture: CapturePath
    out: Path
    """Folder of the results; a run that stopped there is continued."""
    size: str | None = None
    """Image size WxH; default the capture's own. --quality streams smaller ones."""
    stride: int | None = None
    """Use every STRIDE-th frame; default 1. eval without --context (interleaved): such that 73 to 145 are left."""
    quality: QualityOption = "accurate"
    refine: int | None = None
    """Steps of refinement on the streamed views after the stream: 100 with --quality best, 0 with the others."""
    online_refine: int = 0
    """Gradient steps on kept views after each chunk, while streaming; later chunks see the refined scene."""
    revise: Literal["poses"] | None = None
    """Adjust the poses to the images before the stream."""
    causal: bool = False
    """No look-ahead: near, far and scale come from the first chunk, and frames keep their order."""
    weights: WeightsOption = "tiny"
    set: ConfigChanges = ()
    axes: AxesOption = None
    poses: PosesOption = None
    depth: DepthOption = None
    quiet: QuietOption = False

    @property
    def path(self) -> str:
        """The capture as `open_capture` takes it."""
        return capture_path(self.capture, self.axes, self.poses, self.depth)

    @property
    def scale(self) -> float:
        """Size of the streamed images relative to `size`."""
        return QUALITIES[self.quality].scale

    @property
    def refine_steps(self) -> int:
        """Refinement steps after the stream: those asked for with --refine, else those of --quality."""
        return QUALITIES[self.quality].refine_steps if self.refine is None else self.refine

    def load_model(self, *, causal: bool):
        """(model, params) with the changes that options ask for.

        Raises:
            InputError: see `load_model`, or a number of steps is negative.
        """
        check_steps(self.refine_steps, "--refine")
        check_steps(self.online_refine, "--online-refine")
        changes = (*self.set, "stream.causal=true") if causal else self.set
        if self.online_refine:
            changes = (*changes, f"stream.steps_per_chunk={self.online_refine}")
        return load_model(self.weights, changes)


def load_plugin(group: str, name: str, options: Iterable[str]) -> Callable[..., Any]:
    """The function that registers as the entry point `name` of a group: the library does not import its experiments.

    Args:
        group: `ssplat_jax.experiments` or `ssplat_jax.benchmarks`; other packages may add to both.
        name: the entry point.
        options: names of the arguments that it will be given.

    Raises:
        InputError: there is no such entry point, or its function lacks an argument.
    """
    kind = group.rpartition(".")[2].removesuffix("s")
    found = {point.name: point for point in entry_points(group=group)}
    if name not in found:
        raise InputError(f"{kind}: wanted one of {', '.join(sorted(found))}, got {name!r}.")
    run = found[name].load()
    for option in options:
        if option not in inspect.signature(run).parameters:
            raise InputError(f"--{option}: {kind} {name} has no use for it; leave it out.")
    return run
