"""Graceful interruption: the first Ctrl-C or SIGTERM is recorded, a second one has its usual effect."""

import signal
import threading


class Interrupts:
    """Context manager that records the first SIGINT or SIGTERM, so that the caller can save its state and exit.

    Attributes:
        received: number of the signal, or None. Always None outside the main thread, where Python does not allow
            signal handlers.
        has_work: False while there is nothing to save: Ctrl-C then has its usual effect at once, instead of after a
            compilation that may take a minute. The caller sets it when the first step is done.
    """

    def __init__(self, *, has_work: bool = True) -> None:
        self.received: int | None = None
        self.has_work = has_work
        self._previous: dict = {}

    def __enter__(self) -> "Interrupts":
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                if signal.getsignal(number) is signal.SIG_IGN:
                    continue  # as of a background job, which the shell has told to ignore Ctrl-C
                self._previous[number] = signal.signal(number, self._record)
        return self

    def _record(self, number, frame) -> None:
        previous = self._previous[number]
        if not self.has_work and callable(previous):
            previous(number, frame)
            return
        self.received = number
        signal.signal(number, previous)

    def __exit__(self, *_) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
