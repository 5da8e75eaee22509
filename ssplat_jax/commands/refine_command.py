"""`ssplat refine`: gradient steps on the scene of a finished run."""

import dataclasses
import sys
from pathlib import Path
from typing import Annotated

import tyro

from ssplat_jax.commands.options import (
    AxesOption,
    CapturePath,
    PosesOption,
    QuietOption,
    WeightsOption,
    capture_path,
    check_steps,
)


@dataclasses.dataclass(frozen=True)
class Refine:
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

        check_steps(self.steps, "--steps")
        result = refine_run(
            self.folder,
            capture_path(self.capture, self.axes, self.poses),
            load_params(self.weights),
            steps=self.steps,
            save_every=self.save_every,
            overwrite=self.overwrite,
            reporter=Reporter(self.quiet),
        )
        if result.interrupted:
            how = " without --overwrite" if self.overwrite else ""
            print(f"stopped after {result.num_steps} steps; the same command{how} continues", file=sys.stderr)
            return 128 + result.interrupted
        before, after = (scores["shown"]["psnr"] for scores in (result.before, result.after))
        print(
            f"wrote {self.folder}/refined.ply: {result.num_steps} steps, streamed views shown at {after:.2f} dB"
            f" instead of {before:.2f}"
        )
        return 0
