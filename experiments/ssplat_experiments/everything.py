"""All tables and figures by one command, on one page.

    ssplat experiment all --scale smoke --out runs/all

Runs the experiments of `STUDIES` one after another, each in its folder below `results/`, and writes `results.md`, the
pages of all of them. A stopped run continues: cases that are there are not measured again. With `--out docs` the page
lies where the documentation can take it up.
"""

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
from ssplat_experiments.study import PAGE, Study, run_study
from ssplat_jax.console import Reporter
from ssplat_jax.errors import StorageError
from ssplat_jax.storage.atomic import write_atomic

STUDIES: tuple[Study, ...] = (
    context_length.STUDY,
    long_context.STUDY,
    ablation.STUDY,
    memory_curve.STUDY,
    latency.STUDY,
    additions.STUDY,
    accuracy_vs_time.STUDY,
)
FOLDER = "results"


def run(captures: Path | None, out: Path, scale: str, reporter: Reporter) -> str:
    """Runs every study, then writes the page of all."""
    with reporter.progress("all experiments", len(STUDIES)) as advance:
        for done, study in enumerate(STUDIES):
            advance(done, study.name)
            reporter.say(run_study(study, captures, out / FOLDER / study.name, scale, Reporter(quiet=True)))
        advance(len(STUDIES), "")
    write_atomic(out / f"{FOLDER}.md", _page(out, scale).encode())
    return f"wrote {out}/{FOLDER}.md: {len(STUDIES)} experiments"


def _page(out: Path, scale: str) -> str:
    """The pages of all studies below one heading, their pictures found from the folder `out`."""
    parts = [
        "# Results",
        "Tables and figures of the experiments, as this command wrote them. Beside each row stand the hash of its "
        "configuration, the commit (`+`: with changes), the date and the machine.",
        f"    ssplat experiment all --scale {scale} --out runs/all",
    ]
    for study in STUDIES:
        folder = out / FOLDER / study.name
        try:
            text = (folder / PAGE).read_text()
        except OSError as error:
            raise StorageError(f"{folder / PAGE}: cannot be read ({error.strerror}); run the command again.") from error
        parts.append("#" + text.replace("](", f"]({FOLDER}/{study.name}/").strip())
    return "\n\n".join(parts) + "\n"
