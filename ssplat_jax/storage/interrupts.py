"""Ctrl-C and SIGTERM as a request: finish what is under way, save, leave. A second one has its usual effect."""

import signal
import threading


class Interrupts:
    """Context in which `received` holds the number of the first SIGINT or SIGTERM, or None.

    Outside the main thread, where Python takes no handlers, it only ever holds None.
    """

    def __init__(self) -> None:
        self.received: int | None = None
        self._previous: dict = {}

    def __enter__(self) -> "Interrupts":
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._previous[number] = signal.signal(number, self._note)
        return self

    def _note(self, number, frame) -> None:
        self.received = number
        signal.signal(number, self._previous[number])

    def __exit__(self, *_) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
