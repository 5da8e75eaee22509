"""The commands that stream a capture: `ssplat run`, `refine`, `eval` and `demo`."""

import dataclasses
from pathlib import Path
from typing import Literal

from ssplat_jax.core.errors import InputError, require_count
from ssplat_jax.runs.options import EvalOptions, QuietOption, RefineOptions, RunOptions, stopped


@dataclasses.dataclass(frozen=True)
class Refine(RefineOptions):
    """Refine the scene of a run on its own frames: refined.ply beside scene.ply. Continues a stopped refinement.

    Example: ssplat refine runs/kitchen path/to/capture --steps 100
    """

    def run(self) -> int:
        from ssplat_jax.core.console import Reporter
        from ssplat_jax.runs.refine_run import refine_run
        from ssplat_jax.storage.weights import load_params

        require_count(steps=self.steps)
        result = refine_run(load_params(self.weights), self, Reporter(self.quiet))
        if result.interrupted:
            return stopped(result.interrupted, f"after {result.num_steps} steps", overwrites=self.overwrite)
        before, after = (scores["shown"]["psnr"] for scores in (result.before, result.after))
        print(
            f"wrote {self.folder}/refined.ply: {result.num_steps} steps, streamed views shown at {after:.2f} dB"
            f" instead of {before:.2f}"
        )
        return 0


@dataclasses.dataclass(frozen=True)
class Run(RunOptions):
    """Stream a capture into a scene, scene.ply, and refine it into refined.ply. Continues where it was stopped.

    Example: ssplat run path/to/capture --stride 5 --size 320x240 --out runs/kitchen
    """

    def run(self) -> int:
        self._check()
        if not self.view:
            return self._stream_and_refine()
        from ssplat_jax.viewer.view_scene import viewer_beside

        with viewer_beside(self.out, self.port) as wait_for_viewer:
            if code := self._stream_and_refine():
                return code
            print("the viewer stays open; Ctrl-C ends it", flush=True)
            ended = wait_for_viewer()
        return 128 + ended if ended else 0

    def _check(self) -> None:
        """Refuses options that contradict each other."""
        from ssplat_jax.data.posed_image import split_options

        if self.quiet_seconds != Run.quiet_seconds and not self.watch:
            raise InputError("--quiet-seconds: wanted --watch beside it, which it is for; got none.")
        if self.port != Run.port and not self.view:
            raise InputError("--port: wanted --view beside it, which it is for; got none.")
        if self.watch and split_options(self.path)[1]:
            wanted, got = "transforms.json as it is, without depth maps", "--axes, --poses or --depth"
            raise InputError(f"--watch: wanted {wanted}, got {got}; leave it out.")

    def _stream_and_refine(self) -> int:
        """Streams, prints a summary, then refines if requested; returns the exit code."""
        from ssplat_jax.core.console import Reporter
        from ssplat_jax.runs.capture_run import run_capture

        model, params = self.load_model(causal=self.causal or self.watch)
        result = run_capture(model, params, self, Reporter(self.quiet))
        if result.interrupted:
            return stopped(result.interrupted, f"after {result.num_views} views", overwrites=self.overwrite)
        scene = f"scene.ply ({result.num_gaussians} Gaussians from {result.num_views} views)"
        if result.was_finished:
            print(f"{self.out} holds this run, finished: {scene}, views/, metrics.json; --overwrite starts it anew")
        else:
            print(f"wrote {self.out}/{scene}; pictures and figures: {self.out}/report.html")
        if not self.refine_steps:
            return 0
        same = {name: getattr(self, name) for name in ("capture", "weights", "overwrite", "axes", "poses", "quiet")}
        return Refine(self.out, steps=self.refine_steps, **same).run()


@dataclasses.dataclass(frozen=True)
class Eval(EvalOptions):
    """Score novel views of a capture: metrics.json, index.json and target | render | depth pictures.

    Options that are left out follow from the capture. With --index, the capture may be a folder of the index's scenes.

    Example: ssplat eval path/to/capture --size 320x240 --out runs/eval
    """

    def run(self) -> int:
        from ssplat_jax.core.console import Reporter
        from ssplat_jax.runs.evaluate_run import evaluate_run
        from ssplat_jax.storage.run_folder import lock_folder

        model, params = self.load_model(causal=self.causal)
        with lock_folder(self.out):
            metrics = evaluate_run(model, params, self, Reporter(self.quiet))
        if "scenes" in metrics:
            scores = _both_scores(metrics["over_scenes"])
            print(f"{len(metrics['scenes'])} scenes: {scores}; {self.out}/metrics.json, {self.out}/*/report.html")
        else:
            self._print(metrics)
        return 0

    def _print(self, metrics: dict) -> None:
        """Prints the scores of one capture."""
        reference = metrics["baselines"]
        print(
            f"{metrics['capture']}, {metrics['target_views']} views: {_both_scores(metrics)} (copying the nearest view"
            f" {reference['nearest_view_psnr']:.2f}, a mean color {reference['mean_color_psnr']:.2f});"
            f" {metrics['chunk_ms']['median']:.0f} ms a chunk; {self.out}/report.html, {self.out}/metrics.json"
        )
        if refined := metrics.get("refinement"):
            print(
                f"before {refined['num_steps']} refinement steps of {refined['seconds_per_step']:.2f} s:"
                f" {_both_scores(refined['before'])}"
            )


def _both_scores(scores: dict) -> str:
    """PSNR and SSIM in words: of the image that is shown, then literal."""
    return ", ".join(
        f"{name} {scores[name]['psnr']:.2f} dB {scores[name]['ssim']:.3f}" for name in ("shown", "literal")
    )


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
        from ssplat_jax.runs.demo import run_demo
        from ssplat_jax.storage.run_folder import lock_folder

        reporter = Reporter(self.quiet)
        reporter.say("about a minute on two cores, most of it for compiling")
        with lock_folder(self.out):
            run_demo(self.scene, self.out, reporter)
        print(f"wrote {self.out}/scene.ply, metrics.json and pictures")
        reporter.say(
            f"next: `ssplat view {self.out}` shows the scene in a browser; `ssplat run CAPTURE --out runs/mine` makes"
            " one of your own images"
        )
        return 0
