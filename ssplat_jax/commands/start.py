"""The entry point of the `ssplat` script: Ctrl-C ends every command with a line on stderr and exit code 130.

jaxlib compiles on a thread of its own. An exception from the signal handler makes the waiting call return at once, and
the thread goes on with data that the caller then frees, which ends in a segmentation fault (jaxlib 0.10.1). While
jaxlib is imported, its C++ code calls Python, and an exception there aborts the process. So an interrupt that comes
while JAX works ends the process from the handler, without an exception. Any other interrupt unwinds the command,
flushes its output and leaves without taking the interpreter down: that would free the device under such a thread.
"""

import contextlib
import io
import os
import signal
import sys
import threading
from types import FrameType
from typing import NoReturn

EXIT_INTERRUPTED, MESSAGE = 130, "ssplat: interrupted\n"
EXIT_BROKEN_PIPE = 128 + getattr(signal, "SIGPIPE", 13)

PATIENCE = 5.0
"""Seconds that a command has to unwind after Ctrl-C; then the process ends where it stands, as after a kill."""


def start() -> None:
    """Runs the command line of this process and exits with its code."""
    if sys.platform == "win32":  # it can neither lock nor flush a folder as we do
        _leave(2, "ssplat: wanted Linux or macOS, got Windows; use the Windows Subsystem for Linux.\n")
    if sys.flags.optimize > 1:
        _leave(2, "ssplat: wanted Python with docstrings, which scikit-image needs, got -OO; leave it out.\n")
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a name that the terminal's encoding lacks ends no command
            stream.reconfigure(errors="backslashreplace")
    interrupt = _Interrupt()
    try:
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # a background job may ignore the signal
            signal.signal(signal.SIGINT, interrupt.receive)
            sys.unraisablehook = interrupt.leave_if_swallowed
        from ssplat_jax.commands.main import main

        try:
            main()
        finally:
            if sys.stdout is not None:  # closed, as by `>&-`
                sys.stdout.flush()
    except BrokenPipeError:  # nobody reads on, as in `ssplat --help | head -3`
        if not interrupt.received:
            _leave(EXIT_BROKEN_PIPE)
    except SystemExit as ended:
        if ended.code in (EXIT_INTERRUPTED, 128 + signal.SIGTERM):  # the command has said so
            _leave(int(ended.code))
        if not interrupt.received:
            # All is done: Ctrl-C in the interpreter's last moments, when no handler runs, changes nothing.
            signal.signal(signal.SIGINT, signal.SIG_IGN)
            raise
    except BaseException:  # while modules are imported, a KeyboardInterrupt may come out as another error
        if not interrupt.received:
            raise
    _leave(EXIT_INTERRUPTED, MESSAGE)


class _Interrupt:
    """Handler of SIGINT: the first one raises KeyboardInterrupt; a second one, or one inside JAX, ends the process."""

    def __init__(self) -> None:
        self.received = False

    def receive(self, number: int, frame: FrameType | None) -> None:
        if self.received or _is_inside_jax(frame):
            _leave(EXIT_INTERRUPTED, MESSAGE)
        self.received = True
        # A callback out of compiled code may swallow the exception.
        end = threading.Timer(PATIENCE, _leave, (EXIT_INTERRUPTED, MESSAGE))
        end.daemon = True
        end.start()
        raise KeyboardInterrupt

    def leave_if_swallowed(self, unraisable: "sys.UnraisableHookArgs") -> None:
        """Hook of errors that Python cannot raise: those in destructors and in callbacks of the garbage collector."""
        if self.received and issubclass(unraisable.exc_type, KeyboardInterrupt):
            _leave(EXIT_INTERRUPTED, MESSAGE)
        sys.__unraisablehook__(unraisable)


def _is_inside_jax(frame: FrameType | None) -> bool:
    """True if the interrupted function, or one that called it, belongs to JAX."""
    while frame is not None:
        if str(frame.f_globals.get("__name__")).partition(".")[0] in ("jax", "jaxlib"):
            return True
        frame = frame.f_back
    return False


def _leave(code: int, message: str = "") -> NoReturn:
    """Ends the process after flushing its output; nothing else is taken down."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(Exception):  # a closed pipe; a stream that the interrupted code is writing to
            stream.flush()
    with contextlib.suppress(OSError):
        shown = "\x1b[?25h" if os.isatty(2) else ""  # a progress bar may have hidden the cursor
        os.write(2, f"{shown}{message}".encode())
    os._exit(code)


if __name__ == "__main__":
    start()
