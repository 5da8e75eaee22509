"""`run_study`: measures the cases of an experiment and writes its table (JSON and CSV), its plot and its page."""

import csv
import dataclasses
import functools
import importlib.metadata
import io
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from ssplat_experiments.cases import PICTURE, Case, Row, measure_cases
from ssplat_jax.core.atomic import write_atomic
from ssplat_jax.core.console import Reporter
from ssplat_jax.evaluation.cost import OOM, commit
from ssplat_jax.storage.files import write_json
from ssplat_jax.storage.run_folder import make_writable

T = TypeVar("T")

SCALES = ("smoke", "cpu", "gpu")  # sizes of an experiment: seconds, two cores, a GPU

PAGE, PLOT = "page.md", "plot.png"


@dataclasses.dataclass(frozen=True)
class Study:
    """An experiment as cases and what is made of their rows."""

    name: str
    text: str  # text of the page above the table
    cases: Callable[[Path | None, str], Sequence[Case]]  # the cases for a folder of captures and a scale
    finish: Callable[[list[Row]], None] = lambda rows: None  # adds columns that follow from all rows
    plot: Callable[[Any, list[Row]], Any] | None = None  # draws the rows with pyplot and returns the figure
    findings: Callable[[list[Row]], Sequence[str]] = lambda rows: ()
    """Sentences that follow from the rows, printed and written below the table."""


def at_scale(choices: dict[str, T], scale: str) -> T:
    """The choice for a scale; `gpu` takes that of `cpu` where it has none of its own."""
    return choices.get(scale, choices["cpu"])


def run_study(study: Study, captures: Path | None, out: Path, scale: str, reporter: Reporter) -> str:
    """Measures the cases that `out` does not hold yet, and writes `table.json`, `table.csv`, `plot.png` and `page.md`.

    Args:
        study: the experiment.
        captures: folder of real captures, or None.
        out: folder of the results; `cases/` in it holds a file for each case.
        scale: one of `SCALES`.
        reporter: shows progress.

    Returns:
        One line for the terminal.

    Raises:
        InputError: `out` holds results of another request.
        StorageError: `out` cannot be written.
    """
    if scale == "smoke":
        compile_quickly()
    commit()  # read now and kept: the files may change while the experiment runs
    make_writable(out)
    cases = study.cases(captures, scale)
    write = functools.partial(_write, study, out, scale, captures)
    rows = measure_cases(study.name, cases, out / "cases", reporter, write)
    write(rows)
    if study.plot is not None:
        _save_plot(study, rows, out / PLOT, reporter)
    for finding in study.findings(rows):
        reporter.say(finding)
    return f"wrote {out}/{PAGE}, table.json and table.csv: {len(rows)} rows of {len(cases)} cases"


def _save_plot(study: Study, rows: list[Row], path: Path, reporter: Reporter) -> None:
    """Draws the rows as PNG, without a screen; warns where matplotlib is not installed."""
    try:
        import matplotlib

        matplotlib.use("Agg")
        from matplotlib import pyplot
    except ImportError:
        reporter.warn(f"{study.name}: no {path.name} without matplotlib; pip install -e '.[plots]'")
        return
    assert study.plot is not None
    figure, encoded = study.plot(pyplot, rows), io.BytesIO()
    figure.savefig(encoded, dpi=150)
    pyplot.close(figure)
    write_atomic(path, encoded.getvalue())


def compile_quickly() -> None:
    """Lets XLA compile the programs of this process in half the time, which makes them slow; `XLA_FLAGS` goes first.

    Has no effect once JAX has computed something.
    """
    flags = ["--xla_backend_optimization_level=0", "--xla_cpu_parallel_codegen_split_count=1"]
    if importlib.metadata.version("jaxlib").startswith("0.10."):  # later ones do not know the flag
        flags.append("--xla_cpu_use_fusion_emitters=false")
    os.environ.setdefault("XLA_FLAGS", " ".join(flags))


def _write(study: Study, out: Path, scale: str, captures: Path | None, rows: list[Row]) -> None:
    """Adds the columns that follow from all rows, and writes the table in both forms and the page."""
    study.finish(rows)
    write_json(out / "table.json", rows)
    write_atomic(out / "table.csv", csv_table(rows).encode())
    write_atomic(out / PAGE, page(study, scale, rows, captures).encode())


def columns_of(rows: Sequence[Row]) -> list[str]:
    """All columns of the rows, those of the provenance last, in the order of their first appearance."""
    names = list(dict.fromkeys(name for row in rows for name in row if name != PICTURE))
    last = [name for name in ("config", "commit", "date", "machine") if name in names]
    return [name for name in names if name not in last] + last


def csv_table(rows: Sequence[Row]) -> str:
    """The rows as CSV; a missing value is empty."""
    text = io.StringIO()
    writer = csv.DictWriter(text, columns_of(rows), restval="", extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def markdown_table(rows: Sequence[Row]) -> str:
    """The rows as a Markdown table; a missing value is empty, and bytes are given in MiB."""
    columns = columns_of(rows)
    heads = [name.replace("_bytes", "_mib").replace("_", " ") for name in columns]
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(columns)]
    for row in rows:
        lines.append("| " + " | ".join(_cell(name, row.get(name)) for name in columns) + " |")
    return "\n".join(lines) + "\n"


def _cell(name: str, value: Any) -> str:
    if value is None:
        return ""
    if name.endswith("_bytes") and value != OOM:
        return f"{value / 2**20:.1f}"
    if isinstance(value, bool):
        return "yes" if value else ""
    return f"{value:.4g}" if isinstance(value, float) and abs(value) < 1e4 else str(value).replace("|", "/")


def page(study: Study, scale: str, rows: Sequence[Row], captures: Path | None = None) -> str:
    """The page of an experiment: what was done, the command, the table, what follows and the plot."""
    given = "" if captures is None else "--captures path/to/captures "
    command = f"    ssplat experiment {study.name} --scale {scale} {given}--out runs/{study.name}"
    parts = [f"# {study.name}", study.text.strip(), command]
    if rows:
        parts.append(markdown_table(rows).strip())
    parts += study.findings(list(rows))
    if study.plot is not None:
        parts.append(f"![{study.name}]({PLOT})")
    return "\n\n".join(parts) + "\n"
