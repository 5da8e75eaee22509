"""`ssplat worlds`: synthetic worlds as captures with exact poses and depth."""

import dataclasses
from pathlib import Path

from ssplat_jax.commands.options import parse_size
from ssplat_jax.core.errors import require_positive, require_seed


@dataclasses.dataclass(frozen=True)
class Worlds:
    """Render synthetic rooms and streets into capture folders with exact poses and z-depth.

    Example: ssplat worlds --out worlds --count 2 --seed 0
    """

    out: Path
    """Folder of the worlds; a second call with the same options continues."""
    count: int
    """Number of worlds."""
    seed: int = 0
    """Seed; the same seed gives the same files on the same machine."""
    size: str = "320x240"
    """Image size WxH."""
    frames: int = 24
    """Images a world."""

    def run(self) -> int:
        from ssplat_jax.core.console import Reporter
        from ssplat_jax.data.worlds.world_capture import write_worlds

        size = parse_size(self.size)
        assert size is not None
        require_positive(count=self.count, frames=self.frames, size=min(size))
        require_seed(self.seed)
        with Reporter().progress("worlds", self.count, waiting="") as advance:
            rendered = write_worlds(self.out, self.count, self.seed, size, self.frames, advance)
        print(f"{self.out}: {self.count} worlds, {rendered} of them new")
        return 0
