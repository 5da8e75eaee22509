"""Terminal output of the commands: progress bars, tables, warnings and facts."""

import contextlib
from collections.abc import Callable, Iterator, Mapping

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn
from rich.table import Column, Table

WAITING = "compiling"  # note of a bar whose first step is not done: compiling is most of it


class Reporter:
    """Progress, tables and warnings on stderr; if quiet, warnings only."""

    def __init__(self, quiet: bool = False) -> None:
        self.console = Console(stderr=True, quiet=quiet)
        self._warnings = Console(stderr=True)

    @contextlib.contextmanager
    def progress(
        self, name: str, total: int | None, *, waiting: str = WAITING, is_kept: bool = True
    ) -> Iterator[Callable[..., None]]:
        """A progress bar of `total` steps (None: unknown); yields `advance(done, note="")`.

        Until the first call the bar moves to and fro, and its note is `waiting`. At the end it stays if `is_kept`.
        """
        if not (is_kept or self.console.is_terminal):  # rich leaves an empty line in a file
            yield lambda done, note="": None
            return
        columns = "{task.description}", BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), "{task.fields[note]}"
        with Progress(*columns, console=self.console, transient=not is_kept) as bar:
            task = bar.add_task(name, total=None, note=waiting)
            yield lambda done, note="": bar.update(task, completed=done, total=total, note=note)

    def say(self, message: str) -> None:
        """Prints a message: how long something takes, what to do next."""
        self.console.print(message, highlight=False, markup=False, soft_wrap=True)

    def warn(self, message: str) -> None:
        """Prints a warning."""
        # One line however narrow the terminal; brackets are text, not rich's markup.
        self._warnings.print(f"warning: {message}", style="yellow", highlight=False, markup=False, soft_wrap=True)

    def warn_all(self, *messages: str | None) -> None:
        """Prints each message that is not None or empty as a warning."""
        for message in filter(None, messages):
            self.warn(message)

    def table(self, title: str, header: tuple[str, ...], rows: list[tuple]) -> None:
        """Prints a table of right-aligned columns."""
        table = Table(*(Column(name, justify="right") for name in header), title=title)
        for row in rows:
            table.add_row(*map(str, row))
        self.console.print(table)


def print_facts(facts: dict, units: Mapping[str, str]) -> None:
    """Prints facts on stdout, one per line with its unit, then their `warnings`; facts that are None are left out."""
    facts = {name: value for name, value in facts.items() if value is not None}
    width = max(map(len, facts))
    for name, value in facts.items():
        if name != "warnings":
            print(f"{name:<{width}}  {_readable(value)} {units.get(name, '')}".rstrip())
    for warning in facts.get("warnings", ()):
        print(f"warning: {warning}")


def _readable(value) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, (list, tuple)):
        return " x ".join(_readable(v) for v in value)
    return str(value)
