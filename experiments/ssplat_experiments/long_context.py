"""Quality, memory and time of long streams (the paper's Table 2).

    ssplat experiment long_context --out runs/long_context

`ssplat_experiments/context_length.py` with 256, 512 and 1024 views, at `--scale gpu` with one stream of 10,000 too.
"""

import dataclasses
from pathlib import Path

from ssplat_experiments import context_length
from ssplat_experiments.cases import Case
from ssplat_experiments.context_length import Sizes, suite_cases
from ssplat_experiments.study import at_scale, run_study
from ssplat_jax.core.console import Reporter

SIZES = {
    "smoke": (Sizes((8, 24), ("corridor",), (64, 48), targets=3, joint=8),),
    "cpu": (Sizes((24, 256, 512, 1024), ("room",), (96, 72)),),
    "gpu": (
        Sizes((24, 256, 512, 1024), ("room", "corridor"), (480, 256)),
        Sizes((24, 1024, 10_000), ("room",), (128, 96), label=", 128 x 96"),
    ),
}


def run(captures: Path | None, out: Path, scale: str, reporter: Reporter) -> str:
    """Streams every suite with both memories."""
    return run_study(STUDY, captures, out, scale, reporter)


def cases(captures: Path | None, scale: str) -> list[Case]:
    """The cases of every size."""
    return [case for sizes in at_scale(SIZES, scale) for case in suite_cases(captures, sizes)]


STUDY = dataclasses.replace(context_length.STUDY, name="long_context", cases=cases)
