"""`ssplat inspect`: facts and warnings about a capture."""

import dataclasses
from typing import Annotated

import tyro

from ssplat_jax.commands.options import AxesOption, PosesOption, capture_path, parse_size
from ssplat_jax.config import preset


@dataclasses.dataclass(frozen=True)
class Inspect:
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

        path = capture_path(self.capture, self.axes, self.poses)
        capture = open_capture(path, size=parse_size(self.size))
        num_steps = min(NUM_REFERENCES, len(capture))
        with Reporter().progress("matching", num_steps, waiting="") as advance:
            facts = summarize(capture, preset("tiny"), advance)
            advance(num_steps)
        print(json_text(facts)) if self.json else print_facts(facts, UNITS)
        return 0
