"""Options of the commands that stream, refine, score and render, with their help, and what several commands share.

Nothing here imports JAX before a command runs.
"""

import dataclasses
import json
import math
import re
import sys
from pathlib import Path
from typing import Annotated, Literal, get_args, get_type_hints

import tyro

from ssplat_jax.config import PRESETS, QUALITIES, StreamConfig, preset
from ssplat_jax.core.errors import InputError, require_count

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


class OfCapture:
    """Options that all commands share which read a capture."""

    capture: str
    axes: str | None
    poses: str | None
    depth: str | None = None
    size: str | None = None

    @property
    def path(self) -> str:
        """The capture as `open_capture` takes it."""
        from ssplat_jax.data.posed_image import with_options

        return with_options(self.capture, axes=self.axes, poses=self.poses, depth=self.depth)

    @property
    def image_size(self) -> tuple[int, int] | None:
        """(width, height) from "WxH"; None for the capture's own.

        Raises:
            InputError: the text has another form.
        """
        if self.size is None:
            return None
        found = re.fullmatch(r"(\d{1,9})x(\d{1,9})", self.size)
        if not found:
            raise InputError(f"--size: wanted WIDTHxHEIGHT in pixels, got {self.size!r}; for example --size 320x240.")
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


def stopped(by: int, after: str, *, overwrites: bool = False) -> int:
    """Says that a signal stopped a command, which continues when it is repeated; returns the exit code."""
    how = " without --overwrite" if overwrites else ""
    print(f"stopped {after}; the same command{how} continues", file=sys.stderr)
    return 128 + by


@dataclasses.dataclass(frozen=True)
class StreamOptions(OfCapture):
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
    adjust_poses: bool = False
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
    def scale(self) -> float:
        """Size of the streamed images relative to `size`."""
        return QUALITIES[self.quality].scale

    @property
    def refine_steps(self) -> int:
        """Refinement steps after the stream: those asked for with --refine, else those of --quality."""
        return QUALITIES[self.quality].refine_steps if self.refine is None else self.refine

    def load_model(self, *, causal: bool):
        """(model, params) of a preset's shipped weights or of a weights file, with the changes that options ask for.

        Raises:
            InputError: no such weights, a bad change, one that does not fit the weights, or a bad number of steps.
        """
        from ssplat_jax.model.streamsplat import StreamSplat
        from ssplat_jax.storage.weights import check_params, describe_weights, load_params

        require_count(refine=self.refine_steps, online_refine=self.online_refine)
        changes = (*self.set, *["stream.causal=true"] * causal)
        if self.online_refine:
            changes = (*changes, f"stream.steps_per_chunk={self.online_refine}")
        params = load_params(self.weights)
        config = preset(self.weights) if self.weights in PRESETS else describe_weights(self.weights).config
        changed = apply_changes(config, changes)
        if changed != config:
            check_params(params, changed, self.weights)
        return StreamSplat(changed), params


@dataclasses.dataclass(frozen=True)
class RunOptions(StreamOptions):
    """Options of `ssplat run`."""

    quality: QualityOption = "best"
    max_views: int | None = None
    """Stop after this many views."""
    save_every: int = 8
    """Chunks between saved states."""
    overwrite: bool = False
    """Remove the run in the folder and start anew."""
    deltas: bool = False
    """Also write the changes of each chunk, deltas/<views so far>.npz, for `ssplat view` to follow."""
    view: bool = False
    """Open a viewer beside the run, which shows the scene while it grows; implies --deltas (extra `viewer`)."""
    port: int = 8080
    """With --view: its port; the next free one if it is taken."""
    watch: bool = False
    """The folder is still being written (transforms.json): stream chunks as their images are complete, causally."""
    quiet_seconds: float = 10.0
    """With --watch: end after so many seconds without a new frame; a file `done` in the capture ends it at once."""


@dataclasses.dataclass(frozen=True)
class EvalOptions(StreamOptions):
    """Options of `ssplat eval`."""

    context: int | None = None
    """Context views to stream; default 64, or as many as there are."""
    protocol: Literal["interleaved", "paper", "scannet"] = "interleaved"
    """interleaved: every 8th frame from the 5th on is a target. paper: targets uniform over the trajectory. scannet:
    paper's, thinned to 1088 frames, with 64 targets and 8 anchors first."""
    targets: int | None = None
    """paper: number of targets, default 16; scannet: 64. interleaved: most targets to keep, evenly spread."""
    index: Path | None = None
    """Index file {scene: {"context": [], "target": []} | null} that names the frames, instead of a protocol."""
    scene: str | None = None
    """Scene of the index; default the capture's name."""


@dataclasses.dataclass(frozen=True)
class RefineOptions(OfCapture):
    """Options of `ssplat refine`."""

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder of a finished `ssplat run`."""
    capture: CapturePath
    steps: int = 100
    """Most steps; each renders two views."""
    weights: WeightsOption = "tiny"
    save_every: int = 50
    """Steps between saved states."""
    overwrite: bool = False
    """Remove the refinement in the folder and start anew."""
    axes: AxesOption = None
    poses: PosesOption = None
    quiet: QuietOption = False


@dataclasses.dataclass(frozen=True)
class RenderOptions(OfCapture):
    """Options of `ssplat render`."""

    scene: Annotated[Path, tyro.conf.Positional]
    """A scene file (see `ssplat view --help`) in the capture's frame, or the folder of an `ssplat run`."""
    capture: CapturePath
    out: Path
    """Folder of the pictures, views/<frame>.png."""
    stride: int = 1
    """Use every STRIDE-th camera."""
    max_views: int | None = None
    """Stop after this many pictures."""
    size: str | None = None
    """Size WxH of the pictures; default the capture's own."""
    over_black: bool = False
    """Show holes of the scene black instead of in the colors around them."""
    film: int | None = None
    """Also write film.mp4 at 24 frames a second (extra `video`): smooth, FILM frames from each camera to the next."""
    axes: AxesOption = None
    poses: PosesOption = None
    quiet: QuietOption = False
