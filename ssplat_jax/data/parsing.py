"""Untrusted files as text, tables of numbers and JSON, and one sentence for whatever is wrong with them.

Numbers may be NaN or infinite here, so that a later check can name the pose or the field that holds them.
"""

import contextlib
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from ssplat_jax.core.errors import AGAIN, InputError, echo, reading, refusal

UNDISTORT = "undistort the images to pinhole cameras first (`colmap image_undistorter`), or cut them into perspective"
UNDISTORT += " views if they are panoramas (`ns-process-data images --camera-type equirectangular`)"


def load_text(path: Path) -> str:
    """The text of a UTF-8 file, with or without a byte order mark."""
    with reading(path):
        return path.read_bytes().decode("utf-8-sig")


def load_lines(path: Path) -> list[tuple[str, str]]:
    """(location, text) of every line that is not a comment, also of blank ones."""
    lines = [(f"{path}: line {i}", line.strip()) for i, line in enumerate(load_text(path).split("\n"), start=1)]
    return [(where, line) for where, line in lines if not line.startswith("#")]


def load_rows(path: Path, num_columns: int, lines: list[tuple[str, str]] | None = None) -> np.ndarray:
    """A table of numbers from the file `path`, or from its `lines`; blank lines are skipped."""
    lines = load_lines(path) if lines is None else lines
    rows = [parse_numbers(line.split(), where, num_columns) for where, line in lines if line]
    return np.array(rows, np.float64).reshape(-1, num_columns)


def parse_numbers(words: list[str], where: str, count: int | None = None) -> list[float]:
    """Converts words to floats; there must be `count` of them, if that is given."""
    with reading(where):
        if count not in (None, len(words)):
            raise refusal(where, wanted=f"{count} numbers", got=str(len(words)), fix=AGAIN)
        return [float(word) for word in words]


def load_json(path: Path, kind: type = dict) -> Any:
    """The value of a JSON file, which must be an object (`dict`) or a `list`."""
    text = load_text(path)
    with reading(path):
        value = json.loads(text)
    if not isinstance(value, kind):
        wanted = "a JSON object" if kind is dict else "a JSON list"
        raise refusal(str(path), wanted=wanted, got=f"a {type(value).__name__}", fix=AGAIN)
    return value


class Fields:
    """Fields of an untrusted JSON object at the place `where`, each checked when it is read."""

    def __init__(self, fields: Any, where: str) -> None:
        if not isinstance(fields, dict):
            raise refusal(where, wanted="an object", got=echo(fields), fix=AGAIN)
        self._fields, self.where = fields, where

    def get(self, name: str) -> Any:
        """A value as it is; None if it is missing or null."""
        return self._fields.get(name)

    def number(self, name: str, default: float | None = None) -> float:
        """A finite number; `default` where it is missing or null."""
        value = self._fields.get(name)
        value = default if value is None else value
        with contextlib.suppress(OverflowError):  # of an integer too large for float64
            if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
                return float(value)
        raise self._refused(name, "a finite number, written plainly")

    def numbers(self, name: str, shape: tuple[int, ...]) -> Float64[np.ndarray, "..."]:
        """An array of finite numbers of that shape."""
        with contextlib.suppress(TypeError, ValueError, OverflowError):
            array = np.array(self._fields.get(name), np.float64)
            if array.shape == shape and np.isfinite(array).all():
                return array
        raise self._refused(name, f"{' x '.join(map(str, shape))} finite numbers")

    def refuse_lens(self, *names: str) -> None:
        """Refuses fields unless they are missing, false or zeros: the lens that they describe is not modelled."""
        for name in names:
            if np.any(self._fields.get(name) or 0):
                got = echo(self.get(name))
                raise refusal(f"{self.where}.{name}", wanted="no such field, or 0", got=got, fix=UNDISTORT)

    def text(self, name: str) -> str:
        """A text that is not empty."""
        value = self._fields.get(name)
        if isinstance(value, str) and value:
            return value
        raise self._refused(name, "a text")

    def entries(self, name: str) -> list[Any]:
        """A list that is not empty."""
        value = self._fields.get(name)
        if isinstance(value, list) and value:
            return value
        raise self._refused(name, "a list that is not empty")

    def _refused(self, name: str, wanted: str) -> InputError:
        value = self._fields.get(name)
        got = "nothing" if value is None else echo(value)
        return refusal(f"{self.where}.{name}", wanted=wanted, got=got, fix=AGAIN)
