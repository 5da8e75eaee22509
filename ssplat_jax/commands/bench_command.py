"""`ssplat bench`: speed and memory on this machine."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import tyro


@dataclasses.dataclass(frozen=True)
class Bench:
    """Measure speed and memory on this machine; compared candidates are measured in turns.

    Example: ssplat bench render --json render.json
    """

    name: Annotated[Literal["render", "refine", "stream"], tyro.conf.Positional]
    """render: the rasterizer. refine: a step of refinement on a large scene. stream: fuse and projection of the cache,
    and whole steps, with online refinement and without, early and late in a stream."""
    json: Path | None = None
    """Write {machine, date, commit, rows: [{name, value, unit}]} here as well."""
    against: Path | None = None
    """Timed in the same run. render: another rasterizer's Python file, with the functions that docs/performance.md
    names, as experiments/gsplat_rasterizer.py has them. refine: the root of another checkout of this package."""
    scaling: bool = False
    """render only: also 4k to 1M Gaussians, at four image sizes."""
    full_hd: bool = False
    """render only: also 1M Gaussians at 1920 x 1080."""

    def run(self) -> int:
        from ssplat_jax.benchmarks.suite import run_benchmark

        result = run_benchmark(self.name, against=self.against, scaling=self.scaling, full_hd=self.full_hd)
        print(result["machine"])
        for row in result["rows"]:
            print(f"{row['name']:<44} {row['value']:>14.6g} {row['unit']}")
        if self.json is not None:
            from ssplat_jax.storage.files import write_json

            write_json(self.json, result)
        return 0
