"""`ssplat demo`: an embedded scene, streamed with the shipped weights."""

import dataclasses
from pathlib import Path
from typing import Literal

from ssplat_jax.commands.options import QuietOption


@dataclasses.dataclass(frozen=True)
class Demo:
    """Stream an embedded procedural scene with the shipped weights and show how the scene improves with more views.

    Writes scene.ply, pictures and metrics.json.
    Example: ssplat demo
    """

    scene: Literal["room", "orbit", "corridor"] = "room"
    """Scene to stream."""
    out: Path = Path("ssplat_demo")
    """Folder of the results."""
    quiet: QuietOption = False

    def run(self) -> int:
        from ssplat_jax.core.console import Reporter
        from ssplat_jax.runs.demo import run_demo
        from ssplat_jax.storage.run_folder import lock_folder

        reporter = Reporter(self.quiet)
        reporter.say("one to three minutes on two cores, most of it for compiling")
        with lock_folder(self.out):
            run_demo(self.scene, self.out, reporter)
        print(f"wrote {self.out}/scene.ply, metrics.json and pictures")
        reporter.say(
            f"next: `ssplat view {self.out}` shows the scene in a browser; `ssplat run CAPTURE --out runs/mine` makes"
            " one of your own images"
        )
        return 0
