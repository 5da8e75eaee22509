"""`ssplat bench NAME`: the benchmarks of the package in one form, `{machine, rows: [{name, value, unit}]}`."""

import dataclasses
import platform
from pathlib import Path
from typing import Any

import jax

from ssplat_jax.cache.bench import bench_cache
from ssplat_jax.config import preset
from ssplat_jax.errors import InputError
from ssplat_jax.render.bench import bench_render


def run_benchmark(name: str, *, against: Path | None = None, scaling: bool = False) -> dict[str, Any]:
    """Runs the benchmark `render` or `stream`.

    Args:
        name: which.
        against: `render` only: a Python file with `scene` and `render` as the prototype has them, timed in turns.
        scaling: `render` only: also 4k to 1M Gaussians.

    Raises:
        InputError: no such benchmark, or `against` is not a file.
    """
    if name == "render":
        rows = bench_render(against, scaling=scaling)
    elif name == "stream":
        rows = [dataclasses.asdict(row) for row in bench_cache(preset("tiny"))]
    else:
        raise InputError(f"bench: wanted render or stream, got {name!r}.")
    device = jax.devices()[0]
    machine = f"{platform.machine()} {device.platform} {device.device_kind}, jax {jax.__version__}"
    return {"machine": machine, "rows": rows}
