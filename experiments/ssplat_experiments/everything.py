"""All resumable experiments by one command, on one page.

    ssplat experiment all --scale smoke --out runs/all

Each runs in its folder below `results/`; `results.md` holds the pages of all. A stopped run continues.
"""

from pathlib import Path

from ssplat_experiments import ablation, accuracy_vs_time, context_length, cost
from ssplat_experiments.study import PAGE, run_study
from ssplat_jax.core.atomic import write_atomic
from ssplat_jax.core.console import Reporter

STUDIES = (context_length.STUDY, cost.STUDY, accuracy_vs_time.STUDY, ablation.STUDY)  # the last one trains


def run(captures: Path | None, out: Path, scale: str, reporter: Reporter) -> str:
    """Runs every study; the page of all is written after each."""
    pages = ["# Results\n"]
    with reporter.progress("all experiments", len(STUDIES)) as advance:
        for done, study in enumerate(STUDIES):
            advance(done, study.name)
            folder = out / "results" / study.name
            reporter.say(run_study(study, captures, folder, scale, Reporter(quiet=True)))
            pages.append("#" + (folder / PAGE).read_text().replace("](", f"](results/{study.name}/"))
            write_atomic(out / "results.md", "\n".join(pages).encode())
        advance(len(STUDIES), "")
    return f"wrote {out}/results.md: {len(STUDIES)} experiments"
