"""`ssplat export`: a scene in another file format."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import tyro

from ssplat_jax.core.errors import InputError


@dataclasses.dataclass(frozen=True)
class Export:
    """Write the scene of a run, from its saved state, or a scene file in another format.

    Example: ssplat export runs/kitchen --to kitchen.spz
    """

    scene: Annotated[Path, tyro.conf.Positional]
    """Folder of an `ssplat run` or `ssplat demo`, or a scene file."""
    to: Path
    """File to write: .ply or .glb; .spz or .sog, 6 to 8 times smaller; .splat."""
    max_splats: int | None = None
    """Write at most so many Gaussians: opaque ones first, everywhere alike; the number of the others is printed."""
    cameras: str | None = None
    """Capture of a lone scene file: its cameras tell what is up, where a .sog starts, and how the file is shown."""
    up: Literal["y", "z"] | None = None
    """Axis of the file that points up, +y or +z; by default the scene keeps the axes of its capture."""
    spz: Literal[4, 3] = 4
    """Version of a .spz; older readers know 3."""
    weights: str = "tiny"
    """Weights of the run: a preset with shipped weights, or a weights file."""

    def run(self) -> int:
        from ssplat_jax.core.console import Reporter
        from ssplat_jax.runs import export_run as export
        from ssplat_jax.scene_files.formats import check_format, load_scene
        from ssplat_jax.storage.run_folder import RunFolder
        from ssplat_jax.storage.weights import load_params

        check_format(self.to)
        reporter = Reporter(quiet=False)
        folder = RunFolder(self.scene)
        views = export.views_of(self.scene, self.cameras, reporter)
        file = self.scene if self.scene.is_file() else folder.best_scene
        # A run's state is more exact than its scene.ply, and is there before the run ends; `ssplat demo` keeps none.
        if file.exists() and (file != folder.scene or not folder.has_state()):
            if self.weights != Export.weights:
                raise InputError(f"--weights: wanted a run, got {self.scene}, which is decoded already; leave it out.")
            scene = load_scene(file)
        else:
            scene = export.decoded_scene(self.scene, load_params(self.weights), reporter)
        options = {"max_splats": self.max_splats, "spz_version": self.spz}
        report, turn = export.export_scene(scene, self.to, views, self.up, **options)
        if report.warning is not None:
            reporter.warn(f"{self.to.name}: {report.warning}")
        left_out = (
            (report.num_cut, "beyond --max-splats were left out"),
            (report.num_dropped, "more have no visible effect and were not written"),
        )
        words = "; ".join(f"{count} {reason}" for count, reason in left_out if count)
        print(f"wrote {self.to}: {report.num_written} Gaussians{f' ({words})' if words else ''}")
        if views is not None and (difference := export.difference_in_words(self.to, views, turn)):
            print(difference)
        return 0
