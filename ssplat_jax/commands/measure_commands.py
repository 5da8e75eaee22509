"""The commands that measure: `ssplat bench` and `ssplat experiment`, whose functions are found as entry points."""

import dataclasses
import inspect
from collections.abc import Callable, Iterable
from importlib.metadata import entry_points
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from ssplat_jax.core.errors import InputError
from ssplat_jax.runs.stream_commands import QuietOption


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


@dataclasses.dataclass(frozen=True)
class Experiment:
    """Run one of the experiments behind the figures in the documentation.

    Example: ssplat experiment captures --captures path/to/captures --out runs/captures
    """

    name: Annotated[str, tyro.conf.Positional]
    """captures: real captures. context_length: quality and memory against the number of views (the paper's Tables 1
    and 2, Figure 1). ablation: the effect of each module (Table 3). cost: time of each stage. accuracy_vs_time: quality
    against time, of every setting. depth_error: errors of depth by confidence. score: another method's renders. all:
    those that keep finished cases, on one page."""
    out: Path
    """Folder of the tables, plots and pictures."""
    captures: Path | None = None
    """Folder of real captures; some experiments run without."""
    scale: Literal["smoke", "cpu", "gpu"] = "cpu"
    """smoke: the same program on as little data as possible. cpu: sizes for a few cores. gpu: the paper's sizes, where
    an experiment has them."""
    renders: Path | None = None
    """For `score`: folder of another method's renders, with a split.json; --captures is then the capture itself."""
    quiet: QuietOption = False

    def run(self) -> int:
        from ssplat_jax.core.console import Reporter

        more = {} if self.renders is None else {"renders": self.renders}
        run = load_plugin("ssplat_jax.experiments", self.name, more)
        if self.scale == "gpu":
            import jax

            if (backend := jax.default_backend()) != "gpu":
                raise InputError(f"--scale gpu: wanted a GPU, JAX found {backend}; use --scale cpu.")
        if self.renders is None and self.captures is not None and not self.captures.is_dir():
            raise InputError(f"--captures: wanted a folder of captures, got {self.captures}, which is none; check it.")
        self.out.mkdir(parents=True, exist_ok=True)
        print(run(self.captures, self.out, self.scale, Reporter(self.quiet), **more))
        return 0


def load_plugin(group: str, name: str, options: Iterable[str]) -> Callable[..., Any]:
    """The function that registers as the entry point `name` of a group: the library does not import its experiments.

    Args:
        group: `ssplat_jax.experiments` or `ssplat_jax.benchmarks`; other packages may add to both.
        name: the entry point.
        options: names of the arguments that it will be given.

    Raises:
        InputError: there is no such entry point, or its function lacks an argument.
    """
    kind = group.rpartition(".")[2].removesuffix("s")
    found = {point.name: point for point in entry_points(group=group)}
    if name not in found:
        raise InputError(f"{kind}: wanted one of {', '.join(sorted(found))}, got {name!r}.")
    run = found[name].load()
    for option in options:
        if option not in inspect.signature(run).parameters:
            raise InputError(f"--{option}: {kind} {name} has no use for it; leave it out.")
    return run
