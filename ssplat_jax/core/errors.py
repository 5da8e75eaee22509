"""Errors that users can cause. The command line prints each as one line and exits with its code."""

import contextlib
import importlib
import math
from collections.abc import Iterator
from typing import Any


class InputError(ValueError):
    """Input from outside is unusable: a capture, an image, a camera, an option. Exit code 2.

    The message names the file (and field) and says what was wanted, what came, and what to do.
    """


class StorageError(OSError):
    """Saved data cannot be read or written: a full disk, a corrupt checkpoint. Exit code 3."""


class CacheError(RuntimeError):
    """The cache cannot hold its tokens. Raised outside jit by `cache.check_cache`; the message says what to do."""


def is_out_of_memory(error: Exception) -> bool:
    """True if a device's memory is exhausted: XLA raises a RuntimeError of its own that starts with this word."""
    return "RESOURCE_EXHAUSTED" in str(error)


MAX_ECHO_LENGTH = 80  # characters of a refused value that a message repeats, so that it stays one line


def refusal(where: str, *, wanted: str, got: object, fix: str) -> InputError:
    """An `InputError` of one line.

    Args:
        where: the file, and the field in it.
        wanted: what would have been accepted.
        got: what came instead. Strings are shown as they are: pass values from outside through `echo`.
        fix: what to do.
    """
    return InputError(f"{where}: wanted {wanted}, got {got}; {fix}.")


def require_positive(**numbers: int | float | None) -> None:
    """Checks that options, given by their names, are finite and above 0; None counts as not given.

    Raises:
        InputError: naming the first number that is not.
    """
    for name, value in numbers.items():
        if value is not None and not 0 < value < math.inf:
            raise InputError(f"--{name.replace('_', '-')}: wanted a finite number above 0, got {value}.")


def require_count(**numbers: int) -> None:
    """Checks that options, given by their names, are numbers of steps or seeds, which NumPy and JAX take.

    Raises:
        InputError: naming the first number that is not.
    """
    for name, value in numbers.items():
        if not 0 <= value < 2**31:
            raise InputError(f"--{name.replace('_', '-')}: wanted a number from 0 to {2**31 - 1}, got {value}.")


def echo(value: object) -> str:
    """A value from outside as text that is safe to print: one line, escaped, at most `MAX_ECHO_LENGTH` characters."""
    text = ascii(value)
    return text if len(text) <= MAX_ECHO_LENGTH else text[: MAX_ECHO_LENGTH - 3] + "..."


AGAIN = "write the file again"


@contextlib.contextmanager
def reading(where: object, fix: str = AGAIN) -> Iterator[None]:
    """Context in which whatever a parser raises becomes an `InputError` that names `where` and the cause.

    The parsers of NumPy, Pillow and `struct` raise nearly any exception on damaged data, so the block should hold the
    parser alone: a mistake of ours in it would pass for damage.
    """
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        cause = getattr(error, "strerror", None) or str(error)
        got = f"{type(error).__name__} {echo(' '.join(cause.split()))}"
        raise refusal(str(where), wanted="a readable file", got=got, fix=fix) from error


def optional_package(name: str, extra: str) -> Any:
    """The package `name`, which an extra of this one installs.

    Raises:
        InputError: it is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        install = f'pip install -e ".[{extra}]"'
        raise InputError(f"{extra}: wanted the package {name}, which is not installed; run: {install}") from error
