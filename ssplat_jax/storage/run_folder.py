"""Paths of the files in a result folder. Their names are written here and nowhere else."""

import dataclasses
import json
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ssplat_jax.core.atomic import previous_path
from ssplat_jax.core.errors import refusal
from ssplat_jax.storage.folders import remove_numbered

NUMBER = "[0-9]" * 6
"""Pattern of the numbers of views in file names; other files in a run's folders are the user's."""


@dataclasses.dataclass(frozen=True)
class RunFolder:
    """The result folder of `ssplat run`, `demo`, `eval` or `render`; each writes some of these files."""

    path: Path

    @property
    def scene(self) -> Path:
        """The scene, in the capture's frame."""
        return self.path / "scene.ply"

    @property
    def refined_scene(self) -> Path:
        """The refined scene, in the capture's frame; `scene` stays as it was streamed."""
        return self.path / "refined.ply"

    @property
    def refinement(self) -> Path:
        """The losses and scores of the refinement as JSON."""
        return self.path / "refinement.json"

    @property
    def refinement_state(self) -> Path:
        """The saved refinement, from which a stopped one continues."""
        return self.path / "refinement.npz"

    @property
    def state(self) -> Path:
        """The saved stream state, from which a stopped run continues."""
        return self.path / "state.npz"

    @property
    def adjusted_poses(self) -> Path:
        """The poses that were adjusted before the stream, as JSON."""
        return self.path / "adjusted_poses.json"

    @property
    def metrics(self) -> Path:
        """The facts and scores of the run as JSON."""
        return self.path / "metrics.json"

    @property
    def split(self) -> Path:
        """The context and target frames of an evaluation."""
        return self.path / "split.json"

    @property
    def index(self) -> Path:
        """The frames of an evaluation as an index file."""
        return self.path / "index.json"

    def film(self, kind: str = "color") -> Path:
        """The film of a kind that `ssplat render --film` writes: color, depth or normals."""
        return self.path / ("film.mp4" if kind == "color" else f"film_{kind}.mp4")

    @property
    def deltas(self) -> Path:
        """The folder with one file of scene changes per chunk."""
        return self.path / "deltas"

    @property
    def chunk_records(self) -> Path:
        """The folder with one record per chunk."""
        return self.path / "chunks"

    @property
    def report(self) -> Path:
        """The report as one HTML page."""
        return self.path / "report.html"

    @property
    def contact_sheet(self) -> Path:
        """All pictures on one sheet."""
        return self.path / "contact_sheet.jpg"

    @property
    def views(self) -> Path:
        """The folder with one picture per rendered frame."""
        return self.path / "views"

    def delta(self, num_views: int) -> Path:
        """The scene changes of the chunk that brought the stream to `num_views` views."""
        return self.deltas / f"{num_views:06d}.npz"

    def chunk_record(self, num_views: int) -> Path:
        """The record of the chunk that brought the stream to `num_views` views."""
        return self.chunk_records / f"{num_views:06d}.json"

    def chunk_record_files(self) -> list[Path]:
        """All chunk records in stream order; the list is empty if there is no such folder."""
        return sorted(self.chunk_records.glob(f"{NUMBER}.json"))

    def view(self, i: int) -> Path:
        """The picture of frame `i`."""
        return self.views / f"{i:05d}.png"

    def target(self, i: int) -> Path:
        """The picture of target frame `i` of an evaluation or the demo: target | render | depth."""
        return self.path / f"view_{i:05d}.png"

    def has_state(self) -> bool:
        """True if a state, the newest or the one before it, is saved here."""
        return self.state.exists() or previous_path(self.state).exists()

    def check_no_run(self) -> None:
        """Checks that no run is saved here, for commands whose results would replace its files.

        Raises:
            InputError: there is one.
        """
        if self.has_state():
            fix = "choose another folder"
            raise refusal(f"--out {self.path}", wanted="a folder without a run", got="that of a run", fix=fix)

    def has_deltas(self) -> bool:
        """True if at least one delta is saved here."""
        return bool(self.delta_files())

    def delta_files(self) -> list[Path]:
        """All deltas in stream order; the list is empty if there is no such folder."""
        return sorted(self.deltas.glob(f"{NUMBER}.npz"))

    def clear_run(self) -> None:
        """Removes the run that the folder holds; files of the user stay."""
        files = (self.state, previous_path(self.state), self.scene, self.metrics, self.adjusted_poses)
        for stale in files:
            stale.unlink(missing_ok=True)
        self.clear_refinement()
        self.clear_deltas()
        self.clear_report()
        remove_numbered(self.chunk_records, f"{NUMBER}.json")
        self.clear_views()

    def clear_refinement(self) -> None:
        """Removes the refinement; the streamed scene stays."""
        for stale in (self.refinement_state, self.refined_scene, self.refinement):
            stale.unlink(missing_ok=True)

    def clear_deltas(self) -> None:
        """Removes all deltas."""
        remove_numbered(self.deltas, f"{NUMBER}.npz")

    def clear_report(self) -> None:
        """Removes the report and the contact sheet."""
        for stale in (self.report, self.contact_sheet):
            stale.unlink(missing_ok=True)

    def clear_views(self) -> None:
        """Removes the pictures in `views`."""
        remove_numbered(self.views, "#####.png")

    def clear_targets(self) -> None:
        """Removes the pictures of targets."""
        remove_numbered(self.path, "view_#####.png", and_folder=False)


def scene_exposure(scene: Path) -> Float[np.ndarray, "3"]:
    """The RGB factor from the exposure of a run's first views to that of its scene file.

    Args:
        scene: the folder of a run, or its scene.ply or refined.ply.

    Raises:
        InputError: no metrics of a run are beside the scene, or the scene is not one that the run wrote.
    """
    folder = RunFolder(scene if scene.is_dir() else scene.parent)
    is_written = scene.is_dir() or scene.name in (folder.scene.name, folder.refined_scene.name)
    try:
        factors = np.array(json.loads(folder.metrics.read_bytes())["scene_exposure"], np.float64)
        is_known = is_written and factors.shape == (3,) and bool((np.isfinite(factors) & (factors > 0)).all())
    except (OSError, ValueError, TypeError, LookupError):
        is_known = False
    if not is_known:
        got, fix = f"none for {scene}", "give the folder of a finished `ssplat run`, or leave the flag out"
        raise refusal("--one-exposure", wanted="the exposure of the scene in metrics.json", got=got, fix=fix)
    return factors
