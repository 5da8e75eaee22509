"""`ssplat export`: a scene in another file format."""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro


@dataclasses.dataclass(frozen=True)
class Export:
    """Write the scene of a run, from its saved state, or a .ply in another format.

    Example: ssplat export runs/kitchen --to kitchen.spz
    """

    scene: Annotated[Path, tyro.conf.Positional]
    """Folder of an `ssplat run` or `ssplat demo`, or a 3DGS .ply."""
    to: Path
    """File to write: .ply; .spz, a seventh of the size; or .splat, for older browser viewers."""
    weights: str = "tiny"
    """Weights of the run: a preset with shipped weights, or a weights file."""

    def run(self) -> int:
        from ssplat_jax.checkpoint.weights import load_params
        from ssplat_jax.console import Reporter
        from ssplat_jax.runs.export_run import export_run
        from ssplat_jax.scene_files.formats import convert_ply
        from ssplat_jax.storage.run_folder import RunFolder

        reporter = Reporter(quiet=False)
        folder = RunFolder(self.scene)
        if self.scene.is_file():
            report = convert_ply(self.scene, self.to)
        elif not folder.has_state() and folder.scene.exists():  # a folder of `ssplat demo`
            report = convert_ply(folder.scene, self.to)
        else:
            report = export_run(self.scene, self.to, load_params(self.weights), reporter)
        if report.warning is not None:
            reporter.warn(f"{self.to.name}: {report.warning}")
        unseen = (
            f" ({report.num_dropped} more have no visible effect and were not written)" if report.num_dropped else ""
        )
        print(f"wrote {self.to}: {report.num_written} Gaussians{unseen}")
        return 0
