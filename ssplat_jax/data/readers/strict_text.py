"""Reader of untrusted text files of numbers: bounded size, UTF-8; error messages name the line."""

from pathlib import Path

import numpy as np
from jaxtyping import Float64

from ssplat_jax.core.errors import echo, refusal

MAX_BYTES = 1 << 30
COMMENT = "#"  # first character of a comment line


def load_lines(path: Path) -> list[tuple[int, str]]:
    """Returns (number from 1, text) of all lines that are not comments, including blank ones.

    Raises:
        InputError: the file is unreadable, larger than `MAX_BYTES`, or not UTF-8.
    """
    lines = ((number, line.strip()) for number, line in enumerate(read_text(path, MAX_BYTES).split("\n"), start=1))
    return [(number, line) for number, line in lines if not line.startswith(COMMENT)]


def read_text(path: Path, max_bytes: int) -> str:
    """Returns the text of a UTF-8 file of at most `max_bytes`.

    Raises:
        InputError: the file is unreadable, larger, or not UTF-8.
    """
    where = str(path)
    try:
        size = path.stat().st_size
        if size > max_bytes:
            raise refusal(where, wanted=f"at most {max_bytes:,} bytes", got=f"{size:,}", fix="split the capture")
        return path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        fix = "check that the file exists and may be read"
        raise refusal(where, wanted="a readable file", got=error.strerror, fix=fix) from None
    except UnicodeDecodeError as error:
        got = f"byte {error.object[error.start]:#04x} at {error.start}"
        raise refusal(where, wanted="UTF-8 text", got=got, fix="save the file as UTF-8") from None


def parse_numbers(words: list[str], where: str) -> list[float]:
    """Converts words to floats; NaN and infinity are accepted.

    Raises:
        InputError: a word is not a number; the message starts with `where`.
    """
    try:
        return [float(word) for word in words]
    except ValueError:
        bad = next(word for word in words if not _is_number(word))
        raise refusal(where, wanted="a number", got=echo(bad), fix="write the file again") from None


def load_rows(path: Path, num_columns: int, lines: list[tuple[int, str]] | None = None) -> Float64[np.ndarray, "n c"]:
    """Returns a table of numbers from the file `path`, or from its `lines`; blank lines are skipped.

    Raises:
        InputError: the file is unreadable, larger than `MAX_BYTES` or not UTF-8, or a line does not hold `num_columns`
            numbers.
    """
    rows = []
    for number, line in load_lines(path) if lines is None else lines:
        if not line:
            continue
        where, words = f"{path}: line {number}", line.split()
        if len(words) != num_columns:
            got = f"{len(words)}"
            raise refusal(where, wanted=f"{num_columns} numbers", got=got, fix="write the file again")
        rows.append(parse_numbers(words, where))
    return np.array(rows, np.float64).reshape(-1, num_columns)


def _is_number(word: str) -> bool:
    """True if `float` accepts a word."""
    try:
        float(word)
    except ValueError:
        return False
    return True
