"""What commands show while they work: progress bars and tables (rich), or nothing with --quiet."""

import contextlib
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table


class Reporter:
    """Progress and tables on stderr, none when quiet; warnings in any case."""

    def __init__(self, quiet: bool = False) -> None:
        self.console = Console(stderr=True, quiet=quiet)
        self._warnings = Console(stderr=True)

    @contextlib.contextmanager
    def progress(self, name: str, total: int) -> Iterator[Callable[..., None]]:
        """A bar of `total` steps; gives `advance(done, note="")`."""
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[note]}"),
        )
        with Progress(*columns, console=self.console) as bar:
            task = bar.add_task(name, total=total, note="")
            yield lambda done, note="": bar.update(task, completed=done, note=note)

    def warn(self, message: str) -> None:
        """One line that is worth stopping at."""
        # One line however narrow the terminal; brackets are text, not rich's markup.
        self._warnings.print(f"warning: {message}", style="yellow", highlight=False, markup=False, soft_wrap=True)

    def table(self, title: str, header: tuple[str, ...], rows: list[tuple]) -> None:
        """A table of right-aligned columns."""
        table = Table(title=title)
        for name in header:
            table.add_column(name, justify="right")
        for row in rows:
            table.add_row(*map(str, row))
        self.console.print(table)


def print_facts(facts: dict) -> None:
    """Facts on stdout, a line each; warnings last, each on its own line."""
    width = max(map(len, facts))
    for name, value in facts.items():
        if name != "warnings":
            print(f"{name:<{width}}  {_plain(value)}")
    for warning in facts.get("warnings", ()):
        print(f"warning: {warning}")


def _plain(value) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, (list, tuple)):
        return " x ".join(_plain(v) for v in value)
    return str(value)
