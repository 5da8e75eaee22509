"""`ssplat experiment`: the experiments behind the figures in the documentation."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import tyro

from ssplat_jax.commands.options import QuietOption
from ssplat_jax.core.errors import InputError


@dataclasses.dataclass(frozen=True)
class Experiment:
    """Run one of the experiments behind the figures in the documentation.

    Example: ssplat experiment captures --captures path/to/captures --out runs/captures
    """

    name: Annotated[str, tyro.conf.Positional]
    """all: the first seven, on one page. context_length, long_context: quality against the number of views (the paper's
    Tables 1 and 2). ablation: the effect of each module (Table 3). memory_curve: Figure 1. latency: time of each stage.
    additions: the effect of each addition to the paper. accuracy_vs_time, time_to_quality: quality against time.
    refinement: after the stream, while streaming, with wrong poses. captures, more_views, depth_error, error_bands:
    real captures. score: another method's renders."""
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
        import inspect
        from importlib.metadata import entry_points

        from ssplat_jax.core.console import Reporter

        # The library does not import experiments: ours and others' register as entry points of this group.
        found = {point.name: point for point in entry_points(group="ssplat_jax.experiments")}
        if self.name not in found:
            raise InputError(f"experiment: wanted one of {', '.join(sorted(found))}, got {self.name!r}.")
        if self.scale == "gpu":
            import jax

            if (backend := jax.default_backend()) != "gpu":
                raise InputError(f"--scale gpu: wanted a GPU, JAX found {backend}; use --scale cpu.")
        run = found[self.name].load()
        more = {}
        if self.renders is not None:
            if "renders" not in inspect.signature(run).parameters:
                raise InputError(f"--renders: only `experiment score` reads a folder of renders, not {self.name}.")
            more = {"renders": self.renders}
        elif self.captures is not None and not self.captures.is_dir():  # with renders, it is a capture
            raise InputError(f"--captures: wanted a folder of captures, got {self.captures}, which is none; check it.")
        self.out.mkdir(parents=True, exist_ok=True)
        print(run(self.captures, self.out, self.scale, Reporter(self.quiet), **more))
        return 0
