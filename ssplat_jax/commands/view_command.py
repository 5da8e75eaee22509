"""`ssplat view`: a scene in a browser."""

import dataclasses
import sys
from pathlib import Path
from typing import Annotated

import tyro

from ssplat_jax.core.errors import require_positive


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
        ended = view_scene(
            open_source(self.scene),
            host=self.host,
            port=self.port,
            max_gaussians=self.most,
            reporter=reporter,
        )
        print("closed the viewer", file=sys.stderr)
        return 128 + ended
