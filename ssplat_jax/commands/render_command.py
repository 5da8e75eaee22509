"""`ssplat render`: pictures of a scene from the cameras of a capture."""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from ssplat_jax.commands.options import AxesOption, CapturePath, PosesOption, QuietOption, capture_path, parse_size


@dataclasses.dataclass(frozen=True)
class Render:
    """Render a scene from the cameras of a capture, one picture each.

    Example: ssplat render runs/kitchen path/to/capture --stride 10 --out runs/pictures
    """

    scene: Annotated[Path, tyro.conf.Positional]
    """A scene file (.ply, .spz, .sog, .glb, .splat) in the capture's frame, or the folder of an `ssplat run`."""
    capture: CapturePath
    out: Path
    """Folder of the pictures, views/<frame>.png."""
    stride: int = 1
    """Use every STRIDE-th camera."""
    max_views: int | None = None
    """Stop after this many pictures."""
    size: str | None = None
    """Size WxH of the pictures; default the capture's own."""
    over_black: bool = False
    """Show holes of the scene black instead of in the colors around them."""
    one_exposure: bool = False
    """Show a run's scene at the exposure of its first views instead of the middle one of all."""
    film: int | None = None
    """Also write film.mp4, with this many pictures from each camera to the next, 24 a second (extra `video`)."""
    axes: AxesOption = None
    poses: PosesOption = None
    quiet: QuietOption = False

    def run(self) -> int:
        from ssplat_jax.console import Reporter
        from ssplat_jax.runs.render_scene import render_scene

        size, reporter = parse_size(self.size), Reporter(self.quiet)
        num_pictures = render_scene(
            self.scene,
            capture_path(self.capture, self.axes, self.poses),
            self.out,
            size=size,
            stride=self.stride,
            max_views=self.max_views,
            over_black=self.over_black,
            one_exposure=self.one_exposure,
            film_steps=self.film,
            reporter=reporter,
        )
        print(f"wrote {num_pictures} pictures to {self.out}/views" + (", and film.mp4" if self.film else ""))
        return 0
