"""Graceful interruption: the first Ctrl-C or SIGTERM is recorded, a second one has its usual effect."""

import signal
import threading


class Interrupts:
    """Context manager that records the first SIGINT or SIGTERM, so that the caller can save its state and exit.

    Attributes:
        received: number of the signal, or None. Always None outside the main thread, where Python does not allow
            signal handlers.
    """

    def __init__(self) -> None:
        self.received: int | None = None
        self._previous: dict = {}

    def __enter__(self) -> "Interrupts":
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._previous[number] = signal.signal(number, self._record)
        return self

    def _record(self, number, frame) -> None:
        self.received = number
        signal.signal(number, self._previous[number])

    def __exit__(self, *_) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
