"""The one sentence in which every bad input is refused."""

from ssplat_jax.errors import InputError

LONGEST_ECHO = 80  # characters of a refused value that are repeated: a message stays one line


def refusal(where: str, *, wanted: str, got: object, fix: str) -> InputError:
    """An `InputError` of one line: the file and field, what was wanted, what came, what to do.

    `got` is shown as it is when a string written here, so quote values from outside with `echo`.
    """
    return InputError(f"{where}: wanted {wanted}, got {got}; {fix}.")


def echo(value: object) -> str:
    """A value from outside, made safe to print: on one line, escaped, and not longer than `LONGEST_ECHO`."""
    text = ascii(value)
    return text if len(text) <= LONGEST_ECHO else text[: LONGEST_ECHO - 3] + "..."
