"""`ssplat eval`: scores of novel views of a capture."""

import dataclasses
from pathlib import Path
from typing import Literal

from ssplat_jax.commands.options import (
    CapturePath,
    ConfigChanges,
    LpipsHeads,
    QualityOption,
    QuietOption,
    WeightsOption,
    load_lpips_weights,
    load_model,
    parse_size,
)
from ssplat_jax.config import QUALITIES
from ssplat_jax.errors import InputError


@dataclasses.dataclass(frozen=True)
class Eval:
    """Score novel views of a capture: metrics.json and target | render | depth pictures.

    Example: ssplat eval path/to/capture --stride 5 --context 64 --size 320x240 --out runs/eval
    """

    capture: CapturePath
    context: int
    """Context views to stream."""
    out: Path
    """Folder of the results."""
    protocol: Literal["interleaved", "paper"] = "interleaved"
    """interleaved: every 8th frame from the 5th on is a target. paper: targets uniform over the trajectory."""
    stride: int = 1
    """Use every STRIDE-th frame."""
    targets: int | None = None
    """paper: number of targets, default 16. interleaved: most targets to keep, evenly spread."""
    size: str | None = None
    """Image size WxH of the scored views; default the capture's own. --quality sets the streamed size."""
    quality: QualityOption = "accurate"
    refine: int = 0
    """Gradient steps on the context views after the stream; the scores before are reported too."""
    weights: WeightsOption = "tiny"
    lpips_vgg: Path | None = None
    """torchvision's vgg16 state dict (.pth or .npz): with --lpips-heads, LPIPS is scored too."""
    lpips_heads: LpipsHeads = None
    set: ConfigChanges = ()
    quiet: QuietOption = False

    def run(self) -> int:
        from ssplat_jax.console import Reporter
        from ssplat_jax.data.capture import open_capture
        from ssplat_jax.data.split import choose_split
        from ssplat_jax.evaluation.evaluate import evaluate
        from ssplat_jax.streaming.session import Session

        if self.refine < 0:
            raise InputError(f"--refine: wanted a number of steps of at least 0, got {self.refine}.")
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
            refine_steps=self.refine,
        )
        reference = metrics["baselines"]
        print(
            f"{capture.name}, {metrics['target_views']} views: {_both_scores(metrics)} (copying the nearest view"
            f" {reference['nearest_view_psnr']:.2f}, a mean color {reference['mean_color_psnr']:.2f});"
            f" {metrics['chunk_ms']['median']:.0f} ms a chunk; {self.out}/metrics.json"
        )
        if refined := metrics.get("refinement"):
            print(
                f"before {refined['steps']} refinement steps of {refined['seconds_per_step']:.2f} s:"
                f" {_both_scores(refined['before'])}"
            )
        return 0


def _both_scores(scores: dict) -> str:
    """PSNR and SSIM as the paper defines them, and those of the image that is shown."""
    return ", ".join(
        f"{name} {scores[name]['psnr']:.2f} dB {scores[name]['ssim']:.3f}" for name in ("shown", "literal")
    )
