"""What can go wrong outside jit. The command line turns each into one line and an exit code."""


class InputError(ValueError):
    """Input from outside is unusable: a capture, an image, a camera, an option. Exit code 2.

    The message says which file (and field), what was wanted, what came, and what to do.
    """


def require_positive(**numbers: int | float) -> None:
    """Refuses options below what counts one thing.

    Raises:
        InputError: naming the first number that is not positive.
    """
    for name, value in numbers.items():
        if not value > 0:
            raise InputError(f"--{name.replace('_', '-')}: wanted a number above 0, got {value}.")


class StorageError(OSError):
    """Reading or writing saved state failed: a full disk, a corrupt checkpoint. Exit code 3."""


class CacheError(RuntimeError):
    """The cache could not hold what it was given; raised by `cache.check_cache`, outside jit, with the remedy."""


MAX_ECHO_LENGTH = 80  # characters of a refused value that are repeated: a message stays one line


def refusal(where: str, *, wanted: str, got: object, fix: str) -> InputError:
    """An `InputError` of one line: the file and field, what was wanted, what came, what to do.

    `got` is shown as it is when a string written here, so quote values from outside with `echo`.
    """
    return InputError(f"{where}: wanted {wanted}, got {got}; {fix}.")


def echo(value: object) -> str:
    """A value from outside, made safe to print: on one line, escaped, and not longer than `MAX_ECHO_LENGTH`."""
    text = ascii(value)
    return text if len(text) <= MAX_ECHO_LENGTH else text[: MAX_ECHO_LENGTH - 3] + "..."
