"""`ssplat eval`: scores of novel views of a capture."""

import dataclasses
from pathlib import Path
from typing import Literal

from ssplat_jax.commands.options import (
    AxesOption,
    CapturePath,
    ConfigChanges,
    LpipsHeads,
    PosesOption,
    QualityOption,
    QuietOption,
    ReviseOption,
    WeightsOption,
    capture_path,
    causal_changes,
    check_refinement,
    load_lpips_weights,
    load_model,
    online_changes,
    parse_size,
    refinement_steps,
)
from ssplat_jax.config import QUALITIES


@dataclasses.dataclass(frozen=True)
class Eval:
    """Score novel views of a capture: metrics.json, index.json and target | render | depth pictures.

    Options that are left out follow from the capture. With --index, the capture may be a folder of the index's scenes.

    Example: ssplat eval path/to/capture --size 320x240 --out runs/eval
    """

    capture: CapturePath
    out: Path
    """Folder of the results."""
    context: int | None = None
    """Context views to stream; default 64, or as many as there are."""
    protocol: Literal["interleaved", "paper", "scannet"] = "interleaved"
    """interleaved: every 8th frame from the 5th on is a target. paper: targets uniform over the trajectory. scannet:
    paper's, thinned to 1088 frames, with 64 targets and 8 anchors first."""
    stride: int | None = None
    """Use every STRIDE-th frame; default 1, or without --context (interleaved) such that 73 to 145 frames are left."""
    targets: int | None = None
    """paper: number of targets, default 16; scannet: 64. interleaved: most targets to keep, evenly spread."""
    index: Path | None = None
    """Index file {scene: {"context": [], "target": []} | null} that names the frames, instead of a protocol."""
    scene: str | None = None
    """Scene of the index; default the capture's name."""
    size: str | None = None
    """Image size WxH of the scored views; default the capture's own. --quality sets the streamed size."""
    quality: QualityOption = "accurate"
    refine: int | None = None
    """Steps of refinement on the context views after the stream, default 0, with --quality best 100; the scores before
    are reported too."""
    revise: ReviseOption = None
    online_refine: int = 0
    """Gradient steps on kept views after each chunk, while streaming; later chunks see the revised scene."""
    over_black: bool = False
    """Pictures show holes black instead of in the colors around them."""
    one_exposure: bool = False
    """Pictures are at the exposure of the first views instead of that of the nearest streamed ones."""
    causal: bool = False
    """No look-ahead: near, far and scale come from the first chunk, and frames keep their order."""
    weights: WeightsOption = "tiny"
    lpips_vgg: Path | None = None
    """torchvision's vgg16 weights (.safetensors or .npz): with --lpips-heads, LPIPS is scored too."""
    lpips_heads: LpipsHeads = None
    set: ConfigChanges = ()
    axes: AxesOption = None
    poses: PosesOption = None
    quiet: QuietOption = False

    def run(self) -> int:
        from ssplat_jax.core.console import Reporter
        from ssplat_jax.evaluation.scoring import Display
        from ssplat_jax.runs.eval_run import EvalOptions, eval_path
        from ssplat_jax.storage.run_folder import lock_folder

        refine_steps = refinement_steps(self.quality, self.refine)
        check_refinement(refine_steps, "--refine")
        lpips_weights = load_lpips_weights(self.lpips_vgg, self.lpips_heads)
        changes = online_changes(causal_changes(self.set, self.causal), self.online_refine)
        model, params = load_model(self.weights, changes)
        options = EvalOptions(
            size=parse_size(self.size),
            scale=QUALITIES[self.quality].scale,
            protocol=self.protocol,
            stride=self.stride,
            context=self.context,
            targets=self.targets,
            index=self.index,
            scene=self.scene,
            refine_steps=refine_steps,
            revise=self.revise,
            lpips_weights=lpips_weights,
            display=Display(self.over_black, self.one_exposure),
        )
        capture = capture_path(self.capture, self.axes, self.poses)
        with lock_folder(self.out):
            metrics = eval_path(model, params, capture, self.out, options, Reporter(self.quiet))
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
        if self.over_black or self.one_exposure:
            print(f"pictures{_how(self.over_black, self.one_exposure)}: {metrics['pictures']['psnr']:.2f} dB")
        if refined := metrics.get("refinement"):
            print(
                f"before {refined['steps']} refinement steps of {refined['seconds_per_step']:.2f} s:"
                f" {_both_scores(refined['before'])}"
            )


def _how(over_black: bool, one_exposure: bool) -> str:
    """The flags of the pictures in words."""
    return (" over black" if over_black else "") + (" at one exposure" if one_exposure else "")


def _both_scores(scores: dict) -> str:
    """PSNR and SSIM as the paper defines them, and those of the image that is shown."""
    return ", ".join(
        f"{name} {scores[name]['psnr']:.2f} dB {scores[name]['ssim']:.3f}" for name in ("shown", "literal")
    )
