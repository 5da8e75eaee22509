"""`ssplat poses`: camera poses for a video or for photos."""

import dataclasses
import shlex
import sys
from pathlib import Path
from typing import Annotated

import tyro

from ssplat_jax.commands.options import QuietOption
from ssplat_jax.core.errors import InputError, require_positive


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
    """Frames chosen from a video, at most: the sharpest of equal stretches, three a second."""
    max_side: int = 1600
    """Longer side in pixels that larger images are reduced to."""
    fisheye: bool = False
    """The lens is a fish-eye lens."""
    overwrite: bool = False
    """Remove the capture that an earlier call has written to the folder and start anew."""
    quiet: QuietOption = False

    def run(self) -> int:
        from ssplat_jax.core.console import Reporter
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
        size = _small_size(self.out / "images" / found.registered[0])
        place, run = shlex.quote(str(self.out)), shlex.quote(f"runs/{self.out.resolve().name}")
        print(f"next: ssplat run {place} --size {size} --out {run}")
        return 0


def _small_size(image: Path) -> str:
    """WxH of about 320 pixels on the longer side, in the shape of an image."""
    from PIL import Image

    with Image.open(image) as opened:
        sides = opened.size
    return "x".join(str(round(side * min(1.0, 320 / max(sides)))) for side in sides)
