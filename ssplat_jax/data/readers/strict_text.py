"""Text files of numbers from outside: size bounded, UTF-8, every number checked and named by its line."""

from pathlib import Path

import numpy as np
from jaxtyping import Float64

from ssplat_jax.errors import echo, refusal

MAX_BYTES = 1 << 30
COMMENT = "#"


def load_lines(path: Path) -> list[tuple[int, str]]:
    """(number from 1, text) of the lines that are no comments; blank ones are kept.

    Raises:
        InputError: unreadable, larger than 1 GiB, not UTF-8.
    """
    where = str(path)
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise refusal(where, wanted=f"at most {MAX_BYTES:,} bytes", got=f"{size:,}", fix="split the capture")
        text = path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        fix = "check that the file exists and may be read"
        raise refusal(where, wanted="a readable file", got=error.strerror, fix=fix) from None
    except UnicodeDecodeError as error:
        got = f"byte {error.object[error.start]:#04x} at {error.start}"
        raise refusal(where, wanted="UTF-8 text", got=got, fix="save the file as UTF-8") from None
    lines = ((number, line.strip()) for number, line in enumerate(text.split("\n"), start=1))
    return [(number, line) for number, line in lines if not line.startswith(COMMENT)]


def numbers(words: list[str], where: str) -> list[float]:
    """The words as float64, NaN and infinities among them."""
    try:
        return [float(word) for word in words]
    except ValueError:
        bad = next(word for word in words if not _is_number(word))
        raise refusal(where, wanted="a number", got=echo(bad), fix="write the file anew") from None


def load_rows(path: Path, num_columns: int, lines: list[tuple[int, str]] | None = None) -> Float64[np.ndarray, "n c"]:
    """A table of numbers; blank lines are left out.

    Raises:
        InputError: as `load_lines`, or a line with another number of columns or with what is no number.
    """
    rows = []
    for number, line in load_lines(path) if lines is None else lines:
        if not line:
            continue
        where, words = f"{path}: line {number}", line.split()
        if len(words) != num_columns:
            got = f"{len(words)}"
            raise refusal(where, wanted=f"{num_columns} numbers", got=got, fix="write the file anew")
        rows.append(numbers(words, where))
    return np.array(rows, np.float64).reshape(-1, num_columns)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
