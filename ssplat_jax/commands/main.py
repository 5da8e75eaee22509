"""The `ssplat` command line. A command is a dataclass (its fields are the flags) whose `run` is a few calls.

JAX is imported by the commands, not here: `ssplat --help` answers at once. Exit codes: 0 done, 2 bad input or usage,
3 storage, 4 out of device memory, 130/143 interrupted after saving.
"""

import dataclasses
import json
import math
import re
import sys
from pathlib import Path
from typing import Annotated, Literal

import tyro

from ssplat_jax.config import QUALITIES, StreamConfig, preset
from ssplat_jax.errors import CacheError, InputError, StorageError, require_positive

EXIT_INPUT, EXIT_STORAGE, EXIT_MEMORY = 2, 3, 4

QualityName = Literal["fast", "balanced", "accurate"]


@dataclasses.dataclass(frozen=True)
class Demo:
    """Stream an embedded procedural scene with the shipped weights and show what more views give.

    Writes scene.ply, pictures, metrics.json and (with the `plots` extra) a plot.
    Example: ssplat demo
    """

    scene: Literal["room", "orbit", "corridor"] = "room"
    """Which scene."""
    out: Path = Path("ssplat_demo")
    """Where the results go."""
    quality: QualityName = "accurate"
    """What accuracy may cost in time: fast and balanced stream smaller images (docs/performance.md)."""
    quiet: bool = False
    """Print only the closing line."""

    def run(self) -> int:
        from ssplat_jax.console import Reporter
        from ssplat_jax.runs.demo import run_demo

        run_demo(self.scene, self.out, Reporter(self.quiet), QUALITIES[self.quality])
        print(f"wrote {self.out}/scene.ply, metrics.json and pictures")
        return 0


@dataclasses.dataclass(frozen=True)
class Inspect:
    """Say what a capture holds and what a run would make of it: scale, depth range, warnings with remedies.

    Example: ssplat inspect path/to/capture
    """

    capture: Annotated[str, tyro.conf.Positional]
    """Folder of a posed capture, or procedural:NAME. Formats: transforms.json (nerfstudio, instant-ngp, Blender,
    DL3DV); COLMAP (sparse/0 beside images/); ScanNet (color/, pose/, intrinsic/intrinsic_color.txt); TUM RGB-D
    (rgb.txt, groundtruth.txt); RealEstate10K (its .txt, or the folder with that and the frames)."""
    size: str | None = None
    """Image size WxH to work at; default the capture's own."""
    json: bool = False
    """Print JSON instead of a table."""

    def run(self) -> int:
        from ssplat_jax.console import print_facts
        from ssplat_jax.data.capture import open_capture
        from ssplat_jax.data.capture_summary import summarize
        from ssplat_jax.storage.json_files import json_text

        facts = summarize(open_capture(self.capture, size=parse_size(self.size)), preset("tiny")).to_dict()
        print(json_text(facts)) if self.json else print_facts(facts)
        return 0


@dataclasses.dataclass(frozen=True)
class Run:
    """Stream a capture into a scene: scene.ply in the capture's own frame, pictures, metrics.json. Resumes by itself.

    Example: ssplat run path/to/capture --stride 5 --size 320x240 --out runs/kitchen
    """

    capture: Annotated[str, tyro.conf.Positional]
    """Folder of a posed capture (formats: ssplat inspect --help), or procedural:NAME."""
    out: Path
    """Where the results go; a run that was stopped there is continued."""
    stride: int = 1
    """Take every so many-th frame."""
    max_views: int | None = None
    """Stop after so many views."""
    size: str | None = None
    """Image size WxH to work at; default the capture's own."""
    quality: QualityName = "accurate"
    """What accuracy may cost in time: fast and balanced stream smaller images (docs/performance.md)."""
    weights: str = "tiny"
    """Preset with shipped weights, or a weights file."""
    set: tuple[str, ...] = ()
    """Changes to the configuration, as field=value."""
    save_every: int = 8
    """Chunks between saved states."""
    overwrite: bool = False
    """Start anew over what the folder holds."""
    deltas: bool = False
    """Also write what every chunk changed, for a viewer that follows: deltas/<views so far>.npz."""
    quiet: bool = False
    """Print only the closing line."""

    def run(self) -> int:
        from ssplat_jax.console import Reporter
        from ssplat_jax.runs.capture_run import run_capture

        model, params = load_model(self.weights, self.set)
        result = run_capture(
            model,
            params,
            self.capture,
            self.out,
            size=parse_size(self.size),
            scale=QUALITIES[self.quality].scale,
            stride=self.stride,
            max_views=self.max_views,
            save_every=self.save_every,
            overwrite=self.overwrite,
            deltas=self.deltas,
            reporter=Reporter(self.quiet),
        )
        if result.interrupted:
            how = " without --overwrite" if self.overwrite else ""
            print(f"stopped after {result.num_views} views; the same command{how} continues", file=sys.stderr)
            return 128 + result.interrupted
        print(f"wrote {self.out}/scene.ply ({result.num_gaussians} Gaussians from {result.num_views} views)")
        return 0


@dataclasses.dataclass(frozen=True)
class Eval:
    """Score novel views of a capture that the stream never saw: metrics.json and target | render | depth pictures.

    Example: ssplat eval path/to/capture --stride 5 --context 64 --size 320x240 --out runs/eval
    """

    capture: Annotated[str, tyro.conf.Positional]
    """Folder of a posed capture (formats: ssplat inspect --help), or procedural:NAME."""
    context: int
    """Context views to stream."""
    out: Path
    """Where the results go."""
    protocol: Literal["interleaved", "paper"] = "interleaved"
    """interleaved: every 8th frame from the 5th on is a target. paper: targets uniform over the trajectory."""
    stride: int = 1
    """Take every so many-th frame."""
    targets: int | None = None
    """Targets of the paper's protocol (default 16); of the interleaved, the most that are kept, evenly spread."""
    size: str | None = None
    """Image size WxH to score at, and to stream at with the quality `accurate`; default the capture's own."""
    quality: QualityName = "accurate"
    """What accuracy may cost in time: fast and balanced stream smaller images (docs/performance.md)."""
    weights: str = "tiny"
    """Preset with shipped weights, or a weights file."""
    lpips_vgg: Path | None = None
    """torchvision's vgg16 state dict (.pth or .npz): with --lpips-heads, LPIPS is scored too."""
    lpips_heads: Path | None = None
    """The VGG16 heads of the `lpips` package (its weights/v0.1/vgg.pth, or .npz)."""
    set: tuple[str, ...] = ()
    """Changes to the configuration, as field=value."""
    quiet: bool = False
    """Print only the closing line."""

    def run(self) -> int:
        from ssplat_jax.console import Reporter
        from ssplat_jax.data.capture import open_capture
        from ssplat_jax.data.split import choose_split
        from ssplat_jax.evaluation.evaluate import evaluate
        from ssplat_jax.streaming.session import Session

        lpips_weights = load_lpips_weights(self.lpips_vgg, self.lpips_heads)
        model, params = load_model(self.weights, self.set)
        capture = open_capture(self.capture, size=parse_size(self.size))
        streamed = capture.scaled(QUALITIES[self.quality].scale)
        split = choose_split(self.protocol, len(capture), self.stride, self.context, self.targets)
        metrics = evaluate(
            Session(model, params),
            capture,
            split,
            self.out,
            Reporter(self.quiet),
            streamed=streamed,
            lpips_weights=lpips_weights,
        )
        reference = metrics["baselines"]
        print(
            f"{capture.name}: PSNR {metrics['psnr']:.2f} dB, SSIM {metrics['ssim']:.3f} over {metrics['target_views']}"
            f" views (copying the nearest view {reference['nearest_view_psnr']:.2f}, a mean color"
            f" {reference['mean_color_psnr']:.2f}); {metrics['chunk_ms']['median']:.0f} ms a chunk;"
            f" {self.out}/metrics.json"
        )
        return 0


@dataclasses.dataclass(frozen=True)
class Train:
    """Train the network on procedural scenes. Saves as it goes, on Ctrl-C too, and resumes by itself.

    Example: ssplat train --out runs/tiny
    """

    out: Path
    """Log, checkpoints and, at the end, weights.npz."""
    preset: str = "tiny"
    """Configuration."""
    recipe: Literal["tiny", "stream"] = "tiny"
    """`tiny` trains depth, from scratch to the shipped weights; `stream` what comes behind it, for --init-weights."""
    scale_steps: float = 1.0
    """Lengthens or shortens every phase of the recipe."""
    seed: int = 0
    """Of the initial parameters and of the scenes."""
    init_weights: Path | None = None
    """Start from a weights file instead of from random parameters."""
    lpips_vgg: Path | None = None
    """torchvision's vgg16 state dict (.pth or .npz): with --lpips-heads, the rendering loss is MSE + 0.05 LPIPS."""
    lpips_heads: Path | None = None
    """The VGG16 heads of the `lpips` package (its weights/v0.1/vgg.pth, or .npz)."""
    save_every: int = 200
    """Steps between checkpoints."""
    set: tuple[str, ...] = ()
    """Changes to the configuration, as field=value."""
    quiet: bool = False
    """Print only the closing line."""

    def run(self) -> int:
        from ssplat_jax.checkpoint.weights import check_params, load_weights, save_weights
        from ssplat_jax.console import Reporter
        from ssplat_jax.train.loop import train
        from ssplat_jax.train.recipe import RECIPES

        require_positive(scale_steps=self.scale_steps, save_every=self.save_every)
        config = apply_changes(preset(self.preset), self.set)
        recipe = dataclasses.replace(RECIPES[self.recipe].scaled(self.scale_steps), seed=self.seed)
        params = None
        if self.init_weights:
            params = load_weights(self.init_weights)[0]
            check_params(params, config, str(self.init_weights))
        lpips_weights = load_lpips_weights(self.lpips_vgg, self.lpips_heads)
        reporter = Reporter(self.quiet)
        with reporter.progress("training", recipe.num_steps) as advance:
            result = train(
                config,
                recipe,
                self.out,
                params=params,
                lpips_weights=lpips_weights,
                save_every=self.save_every,
                report=lambda record: advance(record["step"], describe_record(record)),
                warn=reporter.warn,
            )
        if result.interrupted:
            print(f"stopped at step {result.step}; the same command continues", file=sys.stderr)
            return 128 + result.interrupted
        provenance = {
            "recipe": dataclasses.asdict(recipe),
            "steps": result.step,
            "init_weights": self.init_weights and self.init_weights.name,
            "rendering_loss": "MSE + 0.05 LPIPS" if lpips_weights else "MSE + image gradients",
        }
        save_weights(self.out / "weights.npz", result.state.ema, config, provenance)
        print(f"wrote {self.out}/weights.npz after {result.step} steps")
        return 0


@dataclasses.dataclass(frozen=True)
class Export:
    """Write the scene of a run again, from its saved state, or a .ply in another format.

    Example: ssplat export runs/kitchen --to kitchen.spz
    """

    scene: Annotated[Path, tyro.conf.Positional]
    """Folder of an `ssplat run`, or a 3DGS .ply."""
    to: Path
    """File to write: .ply; .spz, a seventh of its size; or .splat, which older viewers in browsers take."""
    weights: str = "tiny"
    """The weights of that run."""

    def run(self) -> int:
        from ssplat_jax.checkpoint.weights import load_params
        from ssplat_jax.console import Reporter
        from ssplat_jax.runs.capture_run import export_run
        from ssplat_jax.scene_files.formats import convert_ply

        reporter = Reporter(quiet=False)
        if self.scene.is_file():
            report = convert_ply(self.scene, self.to)
        else:
            report = export_run(self.scene, self.to, load_params(self.weights), reporter)
        if report.warning is not None:
            reporter.warn(f"{self.to.name}: {report.warning}")
        print(
            f"wrote {self.to}: {report.num_written} Gaussians ({report.num_dropped} invisible or not finite left out)"
        )
        return 0


@dataclasses.dataclass(frozen=True)
class ImportWeights:
    """Convert weights that ReSplat's PyTorch code saved, without PyTorch. What the file lacks is initialized afresh.

    DepthSplat's depth network, of RealEstate10K for instance, needs to be told how it was trained: --depth-only
    --set depth_space=inverse match_stride=4 depth_range=[0.5,100].

    Example: ssplat import-weights resplat-small.pth --out small.npz
    """

    checkpoint: Annotated[Path, tyro.conf.Positional]
    """The full model, its depth network or Depth Anything V2: what torch.save wrote, or an .npz of the same names."""
    out: Path
    """Weights file to write: `ssplat run --weights` takes it."""
    preset: Literal["small", "base"] = "small"
    """Size of the network."""
    depth_only: bool = False
    """Leave what stands behind the depth in the file."""
    set: tuple[str, ...] = ()
    """Changes to the configuration, as field=value."""

    def run(self) -> int:
        import numpy as np

        from ssplat_jax.checkpoint.published_weights import import_params
        from ssplat_jax.checkpoint.weights import save_weights

        # The weights were trained with what their code does; --set says otherwise.
        config = apply_changes(preset(self.preset).replace(upstream_compat=True), self.set)
        imported = import_params(self.checkpoint, config, depth_only=self.depth_only)
        provenance = {"imported_from": self.checkpoint.name, "fresh": imported.fresh}
        save_weights(self.out, imported.params, config, provenance, np.float32)
        fresh = ", ".join((*imported.fresh, "HPDA and CGFI, which upstream does not have"))
        print(f"wrote {self.out}: {imported.num_imported} tensors ({imported.num_unused} not used); fresh: {fresh}")
        return 0


@dataclasses.dataclass(frozen=True)
class Render:
    """Render a scene from the cameras of a capture, a picture each.

    Example: ssplat render runs/kitchen path/to/capture --stride 10 --out runs/pictures
    """

    scene: Annotated[Path, tyro.conf.Positional]
    """A 3DGS .ply in the capture's frame, or the folder of an `ssplat run`."""
    capture: Annotated[str, tyro.conf.Positional]
    """Folder of a posed capture (formats: ssplat inspect --help), or procedural:NAME."""
    out: Path
    """Where the pictures go, views/<frame>.png."""
    stride: int = 1
    """Take every so many-th camera."""
    max_views: int | None = None
    """Stop after so many pictures."""
    size: str | None = None
    """Size WxH of the pictures; default the capture's own."""
    over_black: bool = False
    """Show black, not the colors around, where the scene lets light through."""
    film: int | None = None
    """Write film.mp4 too, which takes so many pictures from each camera to the next, 24 a second (extra `video`)."""
    quiet: bool = False
    """No progress."""

    def run(self) -> int:
        from ssplat_jax.console import Reporter
        from ssplat_jax.runs.render_scene import render_scene

        size, reporter = parse_size(self.size), Reporter(self.quiet)
        num_pictures = render_scene(
            self.scene,
            self.capture,
            self.out,
            size=size,
            stride=self.stride,
            max_views=self.max_views,
            over_black=self.over_black,
            film_steps=self.film,
            reporter=reporter,
        )
        print(f"wrote {num_pictures} pictures to {self.out}/views" + (", and film.mp4" if self.film else ""))
        return 0


@dataclasses.dataclass(frozen=True)
class View:
    """Show a scene in a browser, or follow a run (`ssplat run --deltas`) while it grows. Needs the extra `viewer`.

    Example: ssplat view runs/kitchen
    """

    scene: Annotated[Path, tyro.conf.Positional]
    """A 3DGS .ply, or the folder of an `ssplat run`."""
    port: int = 8080
    """Port; the next free one if it is taken."""
    host: str = "127.0.0.1"
    """Address to listen on: this machine alone; 0.0.0.0 lets others look, without a password."""
    most: int = 500_000
    """Most Gaussians sent to a browser; of more, every so many-th."""

    def run(self) -> int:
        from ssplat_jax.console import Reporter
        from ssplat_jax.errors import require_positive
        from ssplat_jax.viewer.view_scene import view_scene

        require_positive(port=self.port, most=self.most)
        view_scene(self.scene, host=self.host, port=self.port, most=self.most, reporter=Reporter(quiet=False))
        return 0


@dataclasses.dataclass(frozen=True)
class Bench:
    """Measure speed and memory on this machine; figures that are compared are taken in turns in one run.

    Example: ssplat bench render --json render.json
    """

    name: Annotated[Literal["render", "stream"], tyro.conf.Positional]
    """render: the rasterizer. stream: the cache's fuse and projection over long streams."""
    json: Path | None = None
    """Write {machine, rows: [{name, value, unit}]} here as well."""
    against: Path | None = None
    """render only: another rasterizer's Python file, timed in the same run: one with the functions that
    docs/performance.md names, as experiments/gsplat_rasterizer.py has them."""
    scaling: bool = False
    """render only: also 4k to 1M Gaussians, at four image sizes."""
    full_hd: bool = False
    """render only: also 1M Gaussians at 1920 x 1080."""

    def run(self) -> int:
        from ssplat_jax.benchmarks.suite import run_benchmark

        result = run_benchmark(self.name, against=self.against, scaling=self.scaling, full_hd=self.full_hd)
        print(result["machine"])
        for row in result["rows"]:
            print(f"{row['name']:<44} {row['value']:>14.6g} {row['unit']}")
        if self.json is not None:
            from ssplat_jax.storage.json_files import write_json

            write_json(self.json, result)
        return 0


@dataclasses.dataclass(frozen=True)
class Experiment:
    """Run one of the experiments that the documentation's figures come from.

    Example: ssplat experiment captures --captures path/to/captures --out runs/captures
    """

    name: Annotated[str, tyro.conf.Positional]
    """captures: novel views of real captures. accuracy_vs_time: what accuracy costs in time.
    ablation: what the cache's modules are worth. depth_error: errors of depth, and whether confidence knows them.
    more_views: the paper's protocol over growing numbers of views."""
    out: Path
    """Tables, plots and pictures."""
    captures: Path | None = None
    """Folder of real captures; experiments that can do without leave them out."""
    scale: Literal["smoke", "full"] = "full"
    """smoke: the same program on as little as shows that it works."""
    quiet: bool = False
    """Print only the closing line."""

    def run(self) -> int:
        from importlib.metadata import entry_points

        from ssplat_jax.console import Reporter

        # The roof is not imported from below: experiments, ours and others', register under this group.
        found = {point.name: point for point in entry_points(group="ssplat_jax.experiments")}
        if self.name not in found:
            raise InputError(f"experiment: wanted one of {', '.join(sorted(found))}, got {self.name!r}.")
        self.out.mkdir(parents=True, exist_ok=True)
        print(found[self.name].load()(self.captures, self.out, self.scale, Reporter(self.quiet)))
        return 0


# -- what the commands share ------------------------------------------------------------------------------------------


def parse_size(text: str | None) -> tuple[int, int] | None:
    """(width, height) of "WxH".

    Raises:
        InputError: of another form.
    """
    if text is None:
        return None
    found = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    if not found:
        raise InputError(f"--size: wanted WIDTHxHEIGHT in pixels, got {text!r}; for example --size 320x240.")
    return int(found[1]), int(found[2])


def apply_changes(config: StreamConfig, changes: tuple[str, ...]) -> StreamConfig:
    """`config` with "field=value" changes; values are JSON, or plain text where that fails.

    Raises:
        InputError: no such field, or a value that it does not take.
    """
    parsed = {}
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
        # A field that takes a word or a number (scene_scale) holds a word; the configuration itself judges both.
        if not isinstance(held, str):
            value = float(value) if isinstance(held, float) and type(value) is int else value
            if held is not None and type(value) is not type(held):
                raise InputError(f"--set {name}: wanted a value like {held!r}, got {text!r}.")
        parsed[name] = value
    return config.replace(**parsed)


def load_model(weights: str, changes: tuple[str, ...]):
    """(model, params) of a preset's shipped weights or of a weights file, with `changes` to its configuration."""
    from ssplat_jax.checkpoint.weights import check_params, load_params, load_weights
    from ssplat_jax.config import PRESETS
    from ssplat_jax.streaming.streamsplat import StreamSplat

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


def load_lpips_weights(vgg: Path | None, heads: Path | None):
    """LPIPS weights of both files, or None where neither is given.

    Raises:
        InputError: only one is given, or a file is not what it should be.
    """
    if vgg is None and heads is None:
        return None
    if vgg is None or heads is None:
        missing, given = ("--lpips-vgg", "--lpips-heads") if vgg is None else ("--lpips-heads", "--lpips-vgg")
        raise InputError(f"{given}: wanted {missing} beside it, LPIPS needs both files; got one.")
    from ssplat_jax.metrics.lpips import load_lpips

    return load_lpips(vgg, heads)


def describe_record(record: dict) -> str:
    """The few numbers of a training record that fit beside a progress bar."""
    shown = {"loss": "loss", "depth_l1": "depth", "psnr": "psnr", "accepted": "accepted"}
    return "  ".join(f"{label} {record[name]:.3f}" for name, label in shown.items() if name in record)


Command = (
    Annotated[Demo, tyro.conf.subcommand("demo")]
    | Annotated[Inspect, tyro.conf.subcommand("inspect")]
    | Annotated[Run, tyro.conf.subcommand("run")]
    | Annotated[Eval, tyro.conf.subcommand("eval")]
    | Annotated[Train, tyro.conf.subcommand("train")]
    | Annotated[Export, tyro.conf.subcommand("export")]
    | Annotated[Render, tyro.conf.subcommand("render")]
    | Annotated[View, tyro.conf.subcommand("view")]
    | Annotated[ImportWeights, tyro.conf.subcommand("import-weights")]
    | Annotated[Bench, tyro.conf.subcommand("bench")]
    | Annotated[Experiment, tyro.conf.subcommand("experiment")]
)


def main(arguments: list[str] | None = None) -> None:
    """Runs one command and exits with its code."""
    command = tyro.cli(
        Command,  # pyright: ignore[reportArgumentType]
        prog="ssplat",
        description="StreamSplat in JAX: a calibrated image stream becomes a 3D Gaussian scene, chunk by chunk.",
        args=arguments,
        config=(tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff),
    )
    sys.exit(guarded(command.run))


def guarded(run) -> int:
    """`run()`; what users can cause becomes one line on stderr and an exit code."""
    try:
        return run()
    except InputError as error:
        return _refuse(error, EXIT_INPUT)
    except (StorageError, OSError) as error:
        return _refuse(error, EXIT_STORAGE)
    except CacheError as error:
        return _refuse(error, EXIT_MEMORY)
    except KeyboardInterrupt:
        return 130
    except Exception as error:
        # XLA reports an exhausted device as a RuntimeError of its own with this word in front.
        if "RESOURCE_EXHAUSTED" in str(error):
            return _refuse("out of device memory; try a smaller --size or capacity.", EXIT_MEMORY)
        raise


def _refuse(message, code: int) -> int:
    print(f"ssplat: {' '.join(str(message).split())}", file=sys.stderr)
    return code


if __name__ == "__main__":
    main()
