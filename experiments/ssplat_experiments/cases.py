"""Cases of an experiment: each is measured once and kept in one file, so that a stopped experiment continues."""

import dataclasses
import functools
import hashlib
import json
import re
import time
from collections.abc import Callable, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from ssplat_experiments.streams import make_room
from ssplat_jax.config import StreamConfig
from ssplat_jax.core.console import Reporter
from ssplat_jax.core.errors import InputError
from ssplat_jax.evaluation.cost import commit, machine, today
from ssplat_jax.evaluation.pictures import save_image
from ssplat_jax.storage.files import json_text, write_json
from ssplat_jax.storage.saved_states import first_difference

Row = dict[str, Any]  # a line of a table: numbers and words by column

PICTURE = "picture"
"""Column of an image. `measure` returns it in [0, 1], height x width x 3; the row that is kept holds its file."""


@dataclasses.dataclass(frozen=True)
class Case:
    """One measurement that is made as a whole."""

    name: str
    config: StreamConfig | None  # None for results of another method
    asked: dict[str, Any]  # everything besides the configuration that decides the result, as JSON types
    measure: Callable[[], Sequence[Row]]

    @property
    def request(self) -> dict[str, Any]:
        """All that decides the result, as JSON holds it."""
        request: dict[str, Any] = {"asked": self.asked, "config": self.config and self.config.to_dict()}
        weights = {} if self.config is None else {"weights": weights_digest()}
        return json.loads(json_text(request | weights))

    def path(self, folder: Path) -> Path:
        """The file of the case."""
        return folder / (re.sub(r"[^a-z0-9.]+", "_", self.name.lower()).strip("_") + ".json")


@functools.cache
def weights_digest() -> str:
    """Digest (12 hex digits) of the shipped weights."""
    return hashlib.sha256((resources.files("ssplat_jax") / "weights" / "tiny.npz").read_bytes()).hexdigest()[:12]


def measure_cases(
    name: str, cases: Sequence[Case], folder: Path, reporter: Reporter, on_case: Callable[[list[Row]], None]
) -> list[Row]:
    """Measures the cases whose file is missing, each into a file of its own, written at once and whole.

    Every file is compared with its case before the first is measured, so that a folder never holds results of two
    configurations.

    Args:
        name: name of the experiment, for the progress bar.
        cases: the cases, in the order of the table.
        folder: where the files are.
        reporter: shows the progress.
        on_case: called with all rows so far after each case that was measured.

    Returns:
        The rows of all cases, each with the machine, the date, the commit and the configuration hash.

    Raises:
        InputError: a file holds the result of another request, or is no such file.
    """
    held = {case.name: _read(case, folder) for case in cases if case.path(folder).exists()}
    if len({case.path(folder) for case in cases}) != len(cases):
        raise ValueError(f"{name}: two cases have the same file.")
    num_held = len(held)
    with reporter.progress(name, len(cases)) as advance:
        advance(num_held, "continued" if num_held else "compiling")
        for case in cases:
            if case.name in held:
                continue
            make_room()
            since = time.perf_counter()
            rows = list(case.measure())
            rows = [_with_file(row, case.path(folder), number) for number, row in enumerate(rows)]
            held[case.name] = _record(name, case, rows, time.perf_counter() - since)
            write_json(case.path(folder), held[case.name])
            on_case(_rows(cases, held))
            advance(len(held), case.name)
    return _rows(cases, held)


def _with_file(row: Row, path: Path, number: int) -> Row:
    """The row with its picture, if it has one, written beside the file of the case."""
    if PICTURE not in row:
        return row
    file = path.with_name(f"{path.stem}_{number}.png")
    save_image(file, row[PICTURE])
    return row | {PICTURE: f"{path.parent.name}/{file.name}"}


def _record(name: str, case: Case, rows: list[Row], seconds: float) -> dict[str, Any]:
    """Contents of the file of a case."""
    return {
        "experiment": name,
        "case": case.name,
        "request": case.request,
        "config": case.config and case.config.hash,
        "commit": commit(),
        "date": today(),
        "machine": machine(),
        "seconds": round(seconds, 2),
        "rows": rows,
    }


def _read(case: Case, folder: Path) -> dict[str, Any]:
    """The file of a case, which must answer the same request."""
    path = case.path(folder)
    try:
        record = json.loads(path.read_text())
        held, _ = record["request"], list(record["rows"])
    except (OSError, ValueError, KeyError, TypeError):
        raise InputError(f"{path}: wanted the result of case {case.name!r}, got something else; remove it.") from None
    if found := first_difference(held, case.request):
        name, before, now = found
        raise InputError(
            f"{path}: was measured with another request ({name}: {before!r}, wanted now {now!r}); choose another --out,"
            " or remove the file to measure it again."
        )
    return record


def _rows(cases: Sequence[Case], held: dict[str, dict[str, Any]]) -> list[Row]:
    """Rows of the cases that are there, each with its provenance."""
    records = [held[case.name] for case in cases if case.name in held]
    origin = ("config", "commit", "date", "machine")
    return [{**row, **{field: record[field] for field in origin}} for record in records for row in record["rows"]]
