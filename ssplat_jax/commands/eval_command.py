"""`ssplat eval`: scores of novel views of a capture."""

import dataclasses
from pathlib import Path
from typing import Literal

from ssplat_jax.commands.options import StreamOptions, parse_size


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
        from ssplat_jax.evaluation.metrics import installed_lpips
        from ssplat_jax.runs.evaluate_run import EvalOptions, evaluate_run
        from ssplat_jax.storage.run_folder import lock_folder

        model, params = self.load_model(causal=self.causal)
        names = ("protocol", "stride", "context", "targets", "index", "scene", "refine_steps", "revise", "scale")
        options = EvalOptions(
            size=parse_size(self.size),
            lpips_weights=installed_lpips(),
            **{name: getattr(self, name) for name in names},
        )
        with lock_folder(self.out):
            metrics = evaluate_run(model, params, self.path, self.out, options, Reporter(self.quiet))
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
                f"before {refined['steps']} refinement steps of {refined['seconds_per_step']:.2f} s:"
                f" {_both_scores(refined['before'])}"
            )


def _both_scores(scores: dict) -> str:
    """PSNR and SSIM as the paper defines them, and those of the image that is shown."""
    return ", ".join(
        f"{name} {scores[name]['psnr']:.2f} dB {scores[name]['ssim']:.3f}" for name in ("shown", "literal")
    )
