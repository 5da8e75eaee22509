"""`Stopwatch`: wall time of work, without the time in which JAX compiles it."""

import contextlib
import time
from collections.abc import Iterable, Iterator
from typing import TypeVar

import jax

Item = TypeVar("Item")
COMPILATION = "/compile/"
"""Part of the name of every event of JAX that is a stage of compilation."""


class Stopwatch:
    """Seconds of all blocks `with watch.running():` together, stages of compilation taken out.

    JAX computes in the background: a block that is timed has to wait for its results.
    """

    def __init__(self) -> None:
        self.seconds = 0.0

    @contextlib.contextmanager
    def running(self) -> Iterator[None]:
        """Counts the time of the block."""
        spans: list[tuple[float, float]] = []

        def note(event: str, duration_secs: float, **_: str | int) -> None:
            if COMPILATION in event:
                spans.append(((now := time.perf_counter()) - duration_secs, now))

        since = time.perf_counter()
        jax.monitoring.register_event_duration_secs_listener(note)
        try:
            yield
        finally:
            jax.monitoring.unregister_event_duration_listener(note)
            end = time.perf_counter()
            self.seconds += end - since - covered(spans, since, end)

    def over(self, items: Iterable[Item]) -> Iterator[Item]:
        """The items, with the time in which each is made counted, and not the time in which it is used."""
        source = iter(items)
        while True:
            with self.running():
                found = next(source, self)
            if found is self:
                return
            yield found  # pyright: ignore[reportReturnType]


def covered(spans: Iterable[tuple[float, float]], since: float, end: float) -> float:
    """Length of the union of spans inside [since, end]: stages of compilation contain others."""
    total, reached = 0.0, since
    for first, last in sorted(spans):
        first, last = max(first, reached), min(last, end)
        total += max(last - first, 0.0)
        reached = max(reached, last)
    return total
