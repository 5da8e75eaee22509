"""`ssplat bench`: speed and memory on this machine."""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from ssplat_jax.commands.options import load_plugin


@dataclasses.dataclass(frozen=True)
class Bench:
    """Measure speed and memory on this machine; compared candidates are measured in turns.

    Example: ssplat bench render --json render.json
    """

    name: Annotated[str, tyro.conf.Positional]
    """render: the rasterizer. effects: what each effect costs and shows. refine: a step of refinement on a large
    scene."""
    json: Path | None = None
    """Write {machine, date, commit, rows: [{name, value, unit}]} here as well."""
    against: Path | None = None
    """Timed in the same run. render: another rasterizer's Python file, as experiments/on_a_gpu.py is one.
    refine: the root of another checkout of this package."""
    large: bool = False
    """render only: also 4k to 1M Gaussians, at five image sizes."""

    def run(self) -> int:
        options = {name: value for name, value in (("against", self.against), ("large", self.large)) if value}
        measure = load_plugin("ssplat_jax.benchmarks", self.name, options)
        from ssplat_jax.evaluation.cost import commit, machine, today
        from ssplat_jax.storage.files import write_json

        result = {"machine": machine(), "date": today(), "commit": commit(), "rows": measure(**options)}
        print(result["machine"])
        for row in result["rows"]:
            print(f"{row['name']:<44} {row['value']:>14.6g} {row['unit']}")
        if self.json is not None:
            write_json(self.json, result)
        return 0
