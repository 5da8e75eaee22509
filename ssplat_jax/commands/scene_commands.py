"""The commands around a stream: `ssplat poses` and `inspect` before it, `export` and `view` after it."""

import dataclasses
import shlex
import sys
from pathlib import Path
from typing import Annotated, Literal

import tyro

from ssplat_jax.config import preset
from ssplat_jax.core.errors import InputError, require_positive
from ssplat_jax.runs.stream_commands import AxesOption, OfCapture, PosesOption, QuietOption
from ssplat_jax.storage.run_folder import RunFolder


@dataclasses.dataclass(frozen=True)
class Poses:
    """Estimate camera poses of a video or of photos, and write a capture: images, transforms.json, sparse/.

    Example: ssplat poses path/to/video.mp4 --out captures/garden
    """

    source: Annotated[Path, tyro.conf.Positional]
    """A video of a scene that stands still, or a folder of photos of it."""
    out: Path
    """Folder of the capture; a call that stopped there is continued."""
    frames: int = 120
    """Frames chosen from a video, at most: sharp ones, at equal distances of motion."""
    max_side: int = 1600
    """Longer side in pixels that larger images are reduced to."""
    fisheye: bool = False
    """The lens is a fish-eye lens."""
    overwrite: bool = False
    """Remove the capture that an earlier call has written to the folder and start anew."""
    quiet: QuietOption = False

    def run(self) -> int:
        from ssplat_jax.core.console import Reporter
        from ssplat_jax.data.images import image_size
        from ssplat_jax.poses.estimate import PoseOptions, estimate_poses

        require_positive(frames=self.frames, max_side=self.max_side)
        if self.source.is_dir() and self.frames != Poses.frames:
            raise InputError(f"--frames: wanted a video, got photos ({self.source}), which are all used; leave it out.")
        options = PoseOptions(max_frames=self.frames, max_side=self.max_side, is_fisheye=self.fisheye)
        try:
            found = estimate_poses(self.source, self.out, options, self.overwrite, Reporter(self.quiet))
        except KeyboardInterrupt:
            how = " without --overwrite" if self.overwrite else ""
            print(f"stopped; the same command{how} continues", file=sys.stderr)
            raise
        print(f"{self.out}: " + "\n".join(found.sentences()))
        width, height = image_size(self.out / "images" / found.registered[0])
        shrink = min(1.0, 320 / max(width, height))
        size = f"{round(width * shrink)}x{round(height * shrink)}"
        place, run = shlex.quote(str(self.out)), shlex.quote(f"runs/{self.out.resolve().name}")
        print(f"next: ssplat run {place} --size {size} --out {run}")
        return 0


@dataclasses.dataclass(frozen=True)
class Inspect(OfCapture):
    """Show the facts of a capture and how a run would use it: scale, depth range, warnings with remedies.

    Example: ssplat inspect path/to/capture
    """

    capture: Annotated[str, tyro.conf.Positional]
    """Folder of a posed capture, or procedural:NAME. Formats: transforms.json (nerfstudio, instant-ngp, Blender,
    DL3DV); COLMAP (sparse/0 beside images/); Polycam (keyframes/); Record3D (metadata.json, rgb/); cameras.json of
    3DGS and LLFF (poses_bounds.npy), each beside images/; ScanNet (color/, pose/, intrinsic/intrinsic_color.txt);
    TUM RGB-D (rgb.txt, groundtruth.txt); KITTI (a folder of sequences/); RealityScan and RealityCapture (a .csv) and
    Metashape (a .xml), each beside images/;
    RealEstate10K (its .txt, or the folder of that file and the frames)."""
    size: str | None = None
    """Image size WxH; default the capture's own."""
    json: bool = False
    """Print JSON instead of a table."""
    axes: AxesOption = None
    poses: PosesOption = None

    def run(self) -> int:
        from ssplat_jax.core.console import Reporter, print_facts
        from ssplat_jax.data.capture_summary import UNITS, summarize
        from ssplat_jax.data.depth_range import NUM_REFERENCES
        from ssplat_jax.data.open_capture import open_capture
        from ssplat_jax.storage.files import json_text

        capture = open_capture(self.path, size=self.image_size)
        num_steps = min(NUM_REFERENCES, len(capture))
        with Reporter().progress("matching", num_steps, waiting="") as advance:
            facts = summarize(capture, preset("tiny"), advance)
            advance(num_steps)
        print(json_text(facts)) if self.json else print_facts(facts, UNITS)
        return 0


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
        from ssplat_jax.runs.scene_outputs import decoded_scene, difference_in_words, export_scene, views_of
        from ssplat_jax.scene_files.formats import check_format, load_scene
        from ssplat_jax.storage.weights import load_params

        check_format(self.to)
        reporter = Reporter(quiet=False)
        folder = RunFolder(self.scene)
        views = views_of(self.scene, self.cameras, reporter)
        file = self.scene if self.scene.is_file() else folder.best_scene
        # A run's state is more exact than its scene.ply, and is there before the run ends; `ssplat demo` keeps none.
        if file.exists() and (file != folder.scene or not folder.has_state()):
            if self.weights != Export.weights:
                raise InputError(f"--weights: wanted a run, got {self.scene}, which is decoded already; leave it out.")
            scene = load_scene(file)
        else:
            scene = decoded_scene(self.scene, load_params(self.weights), reporter)
        options = {"max_splats": self.max_splats, "spz_version": self.spz}
        report, turn = export_scene(scene, self.to, views, self.up, **options)
        if report.warning is not None:
            reporter.warn(f"{self.to.name}: {report.warning}")
        left_out = (
            (report.num_cut, "beyond --max-splats were left out"),
            (report.num_dropped, "more have no visible effect and were not written"),
        )
        words = "; ".join(f"{count} {reason}" for count, reason in left_out if count)
        print(f"wrote {self.to}: {report.num_written} Gaussians{f' ({words})' if words else ''}")
        if views is not None and (difference := difference_in_words(self.to, views, turn)):
            print(difference)
        return 0


@dataclasses.dataclass(frozen=True)
class View:
    """Show a scene in a browser, or follow a run (`ssplat run --deltas`) while it streams. Needs the extra `viewer`.

    Example: ssplat view runs/kitchen
    """

    scene: Annotated[Path, tyro.conf.Positional]
    """A scene file (.ply, .compressed.ply, .spz, .sog, .glb), or the folder of an `ssplat run`."""
    port: int = 8080
    """Port; the next free one if it is taken."""
    host: str = "127.0.0.1"
    """Address to listen on; the default is reached by this machine only, 0.0.0.0 by others, without a password."""
    most: int = 1_500_000
    """Most Gaussians sent to a browser; of larger scenes an even selection is sent, enlarged to cover as much."""

    def run(self) -> int:
        from ssplat_jax.core.console import Reporter
        from ssplat_jax.viewer.stage import open_source
        from ssplat_jax.viewer.view_scene import view_scene

        require_positive(port=self.port, most=self.most)
        reporter = Reporter(quiet=False)
        source = open_source(self.scene)
        ended = view_scene(source, host=self.host, port=self.port, max_gaussians=self.most, reporter=reporter)
        print("closed the viewer", file=sys.stderr)
        return 128 + ended
