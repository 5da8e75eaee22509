"""`ssplat inspect`: facts and warnings about a capture."""

import dataclasses
import sys
from pathlib import Path
from typing import Annotated

import tyro

from ssplat_jax.commands.options import AxesOption, PosesOption, capture_path, parse_size
from ssplat_jax.config import preset
from ssplat_jax.core.errors import InputError


@dataclasses.dataclass(frozen=True)
class Inspect:
    """Show the facts of a capture and how a run would use it: scale, depth range, warnings with remedies.

    Example: ssplat inspect path/to/capture
    """

    capture: Annotated[str, tyro.conf.Positional]
    """Folder of a posed capture, or procedural:NAME. Formats: transforms.json (nerfstudio, instant-ngp, Blender,
    DL3DV); COLMAP (sparse/0 beside images/); Polycam (keyframes/); Record3D (metadata.json, rgb/); cameras.json of
    3DGS, LLFF (poses_bounds.npy) and OpenSfM (reconstruction.json), each beside images/; ScanNet (color/, pose/,
    intrinsic/intrinsic_color.txt); TUM RGB-D (rgb.txt, groundtruth.txt); KITTI (a folder of sequences/);
    RealEstate10K (its .txt, or the folder of that file and the frames)."""
    size: str | None = None
    """Image size WxH; default the capture's own."""
    json: bool = False
    """Print JSON instead of a table."""
    coverage: Path | None = None
    """PNG to write: the capture from above, with the path of the cameras and how many of them see each place."""
    axes: AxesOption = None
    poses: PosesOption = None

    def run(self) -> int:
        from ssplat_jax.core.console import Reporter, print_facts
        from ssplat_jax.data.capture_summary import UNITS, summarize
        from ssplat_jax.data.coverage_map import draw_coverage
        from ssplat_jax.data.depth_range import NUM_REFERENCES
        from ssplat_jax.data.open_capture import open_capture
        from ssplat_jax.evaluation.pictures import save_image
        from ssplat_jax.storage.json_files import json_text

        if self.coverage is not None and self.coverage.suffix.lower() != ".png":
            raise InputError(f"--coverage: wanted a file that ends in .png, got {str(self.coverage)!r}; rename it.")
        path = capture_path(self.capture, self.axes, self.poses)
        capture = open_capture(path, size=parse_size(self.size))
        num_steps = min(NUM_REFERENCES, len(capture))
        with Reporter().progress("matching", num_steps, waiting="") as advance:
            summary = summarize(capture, preset("tiny"), advance)
            advance(num_steps)
        facts = summary.to_dict()
        print(json_text(facts)) if self.json else print_facts(facts, UNITS)
        if self.coverage is not None:
            far = min(summary.far / summary.scene_scale, 2 * summary.median_depth)
            picture = draw_coverage(capture, summary.near / summary.scene_scale, far)
            save_image(self.coverage, picture)
            print(f"wrote {self.coverage}", file=sys.stderr)
        return 0
