"""The commands that stream a capture, `ssplat run`, `refine`, `eval` and `demo`, `ssplat render`, and shared options.

They stand here and not in `commands/`, because the functions of this package take them as their options. Nothing here
imports JAX before a command runs.
"""

import dataclasses
import json
import math
import re
import sys
from pathlib import Path
from typing import Annotated, Literal, get_args, get_type_hints

import tyro

from ssplat_jax.config import PRESETS, StreamConfig, preset
from ssplat_jax.core.errors import InputError, require_count
from ssplat_jax.storage.run_folder import RunFolder, lock_folder

QUALITIES = {"fast": (0.5, 0), "balanced": (0.75, 0), "accurate": (1.0, 0), "best": (1.0, 100)}
"""By `--quality`: the factor by which images are resized before they are streamed, and refinement steps afterwards
(`ssplat experiment accuracy_vs_time`, docs/results.md)."""

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
        group, field = config.find(name)
        held, kinds = config.get(name), get_args(get_type_hints(type(getattr(config, group)))[field])
        # A field that takes a word or a number (scene_scale) holds a word by default; the configuration checks both.
        if not isinstance(held, str) and not (value is None and type(None) in kinds):
            value = float(value) if isinstance(held, float) and type(value) is int else value
            if held is not None and type(value) is not type(held):
                raise InputError(f"--set {name}: wanted a value like {held!r}, got {text!r}.")
        before, first = given.setdefault((group, field), (value, change))
        if before != value:
            fix = "drop one; --causal and --watch set stream.causal, --online-refine sets stream.steps_per_chunk"
            raise InputError(f"--set: wanted one value of {group}.{field}, got {first} and {change}: {fix}.")
        parsed[name] = value
    return config.replace(**parsed)


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
        return QUALITIES[self.quality][0]

    @property
    def refine_steps(self) -> int:
        """Refinement steps after the stream: those asked for with --refine, else those of --quality."""
        return QUALITIES[self.quality][1] if self.refine is None else self.refine

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
class Refine(OfCapture):
    """Refine the scene of a run on its own frames: refined.ply beside scene.ply. Continues a stopped refinement.

    Example: ssplat refine runs/kitchen path/to/capture --steps 100
    """

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

    def run(self) -> int:
        from ssplat_jax.core.console import Reporter
        from ssplat_jax.runs.refine_run import refine_run
        from ssplat_jax.storage.weights import load_params

        require_count(steps=self.steps)
        return refine_run(load_params(self.weights), self, Reporter(self.quiet))


@dataclasses.dataclass(frozen=True)
class Run(StreamOptions):
    """Stream a capture into a scene, scene.ply, and refine it into refined.ply. Continues where it was stopped.

    Example: ssplat run path/to/capture --stride 5 --size 320x240 --out runs/kitchen
    """

    quality: QualityOption = "best"
    max_views: int | None = None
    """Stop after this many views."""
    save_every: int | None = None
    """Chunks between two saves of the stream; by default those of half a minute. A stop saves too."""
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

    def run(self) -> int:
        from ssplat_jax.data.posed_image import split_options

        if self.quiet_seconds != Run.quiet_seconds and not self.watch:
            raise InputError("--quiet-seconds: wanted --watch beside it, which it is for; got none.")
        if self.port != Run.port and not self.view:
            raise InputError("--port: wanted --view beside it, which it is for; got none.")
        if self.watch and split_options(self.path)[1]:
            wanted, got = "transforms.json as it is, without depth maps", "--axes, --poses or --depth"
            raise InputError(f"--watch: wanted {wanted}, got {got}; leave it out.")
        if not self.view:
            return self._stream_and_refine()
        from ssplat_jax.viewer.view_scene import viewer_beside

        with viewer_beside(self.out, self.port) as wait_for_viewer:
            if code := self._stream_and_refine():
                return code
            print("the viewer stays open; Ctrl-C ends it", flush=True)
            ended = wait_for_viewer()
        return 128 + ended if ended else 0

    def _stream_and_refine(self) -> int:
        """Streams, then refines if requested; returns the exit code."""
        from ssplat_jax.core.console import Reporter
        from ssplat_jax.runs.capture_run import run_capture

        model, params = self.load_model(causal=self.causal or self.watch)
        code = run_capture(model, params, self, Reporter(self.quiet))
        if code or not self.refine_steps:
            return code
        same = {name: getattr(self, name) for name in ("capture", "weights", "overwrite", "axes", "poses", "quiet")}
        return Refine(self.out, steps=self.refine_steps, **same).run()


@dataclasses.dataclass(frozen=True)
class Eval(StreamOptions):
    """Score novel views of a capture: metrics.json, index.json and target | render | depth pictures.

    Options that are left out follow from the capture. With --index, the capture may be a folder of the index's scenes.

    Example: ssplat eval path/to/capture --size 320x240 --out runs/eval
    """

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

    def run(self) -> int:
        from ssplat_jax.core.console import Reporter
        from ssplat_jax.runs.evaluate_run import evaluate_run

        model, params = self.load_model(causal=self.causal)
        with lock_folder(self.out):
            metrics = evaluate_run(model, params, self, Reporter(self.quiet))
        if "scenes" in metrics:
            means = metrics["over_scenes"]
            scores = "no means, a scene is out of memory" if means is None else _both_scores(means)
            print(f"{len(metrics['scenes'])} scenes: {scores}; {self.out}/metrics.json, {self.out}/*/report.html")
            return 0
        reference = metrics["baselines"]
        print(
            f"{metrics['capture']}, {metrics['target_views']} views: {_both_scores(metrics)} (copying the nearest view"
            f" {reference['nearest_view_psnr']:.2f}, a mean color {reference['mean_color_psnr']:.2f});"
            f" {metrics['chunk_ms']['median']:.0f} ms a chunk; {self.out}/report.html, {self.out}/metrics.json"
        )
        if refined := metrics.get("refinement"):
            count, seconds = refined["num_steps"], refined["seconds_per_step"]
            print(f"before {count} refinement steps of {seconds:.2f} s: {_both_scores(refined['before'])}")
        return 0


def _both_scores(scores: dict) -> str:
    """PSNR, SSIM and, where its weights are installed, LPIPS: of the image that is shown, then literal."""
    words = []
    for name in ("shown", "literal"):
        score = scores[name]
        lpips = "" if score["lpips"] is None else f" LPIPS {score['lpips']:.3f}"
        words.append(f"{name} {score['psnr']:.2f} dB SSIM {score['ssim']:.3f}{lpips}")
    return ", ".join(words)


@dataclasses.dataclass(frozen=True)
class Demo:
    """Stream an embedded procedural scene with the shipped weights and show how the scene improves with more views.

    Writes scene.ply, pictures and metrics.json.
    Example: ssplat demo
    """

    scene: Literal["room", "orbit", "corridor"] = "room"
    """Scene to stream."""
    out: Path = Path("ssplat_demo")
    """Folder of the results."""
    quiet: QuietOption = False

    def run(self) -> int:
        from ssplat_jax.core.console import Reporter
        from ssplat_jax.runs.evaluate_run import run_demo

        reporter = Reporter(self.quiet)
        reporter.say("about a minute on two cores, most of it for compiling")
        with lock_folder(self.out):
            run_demo(self.scene, self.out, reporter)
        print(f"wrote {self.out}/scene.ply, metrics.json and pictures")
        mine = "`ssplat run CAPTURE --out runs/mine` makes one of your own images"
        reporter.say(f"next: `ssplat view {self.out}` shows the scene in a browser; {mine}")
        return 0


@dataclasses.dataclass(frozen=True)
class Render(OfCapture):
    """Render a scene from the cameras of a capture, one picture each.

    Example: ssplat render runs/kitchen path/to/capture --stride 10 --out runs/pictures
    """

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

    def run(self) -> int:
        from ssplat_jax.core.console import Reporter
        from ssplat_jax.runs.scene_outputs import render_run

        num_pictures = render_run(self, Reporter(self.quiet))
        film_name = f", {RunFolder(self.out).film.name}" if self.film else ""
        print(f"wrote {num_pictures} pictures to {self.out}/views{film_name}")
        return 0
