"""`ssplat experiment`: the experiments behind the figures in the documentation."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import tyro

from ssplat_jax.commands.options import QuietOption, load_plugin
from ssplat_jax.core.errors import InputError


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
