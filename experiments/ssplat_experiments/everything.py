"""The tables and figures of the resumable experiments by one command, on one page.

    ssplat experiment all --scale smoke --out runs/all

Runs the experiments of `STUDIES` one after another, each in its folder below `results/`, and writes `results.md`, the
pages of all that are finished, after each. A stopped run continues: cases that are held are not measured again.
"""

from collections.abc import Sequence
from pathlib import Path

from ssplat_experiments import (
    ablation,
    accuracy_vs_time,
    additions,
    context_length,
    latency,
    long_context,
    memory_curve,
)
from ssplat_experiments.study import PAGE, Study, command_of, run_study
from ssplat_jax.core.atomic import write_atomic
from ssplat_jax.core.console import Reporter
from ssplat_jax.core.errors import StorageError

STUDIES: tuple[Study, ...] = (
    context_length.STUDY,
    long_context.STUDY,
    memory_curve.STUDY,
    latency.STUDY,
    additions.STUDY,
    accuracy_vs_time.STUDY,
    ablation.STUDY,  # last: it trains
)
FOLDER = "results"


def run(captures: Path | None, out: Path, scale: str, reporter: Reporter) -> str:
    """Runs every study, then writes the page of all."""
    with reporter.progress("all experiments", len(STUDIES)) as advance:
        for done, study in enumerate(STUDIES):
            advance(done, study.name)
            reporter.say(run_study(study, captures, out / FOLDER / study.name, scale, Reporter(quiet=True)))
            write_atomic(out / f"{FOLDER}.md", _page(STUDIES[: done + 1], out, scale, captures).encode())
        advance(len(STUDIES), "")
    return f"wrote {out}/{FOLDER}.md: {len(STUDIES)} experiments"


def _page(finished: Sequence[Study], out: Path, scale: str, captures: Path | None) -> str:
    """The pages of the finished studies below one heading, their pictures found from the folder `out`."""
    parts = [
        "# Results",
        "Tables and figures of the experiments, as this command wrote them. Beside each row stand the hash of its "
        "configuration, the commit (`+`: with changes), the date and the machine.",
        command_of("all", scale, captures),
    ]
    for study in finished:
        folder = out / FOLDER / study.name
        try:
            text = (folder / PAGE).read_text()
        except OSError as error:
            raise StorageError(f"{folder / PAGE}: cannot be read ({error.strerror}); run the command again.") from error
        parts.append("#" + text.replace("](", f"]({FOLDER}/{study.name}/").strip())
    if missing := [study.name for study in STUDIES if study not in finished]:
        parts.append(f"Not finished: {', '.join(missing)}.")
    return "\n\n".join(parts) + "\n"
