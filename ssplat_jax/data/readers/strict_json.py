"""Reader of untrusted JSON: bounded size and nesting, UTF-8, no duplicate keys.

NaN and Infinity are accepted as floats, so that a later check can name the field that holds them.
"""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from ssplat_jax.core.errors import echo, refusal
from ssplat_jax.data.readers.strict_text import read_text

MAX_BYTES = 256 << 20  # files of real captures take a few megabytes


class _DuplicateKey(ValueError):
    """A key that occurs twice in an object."""


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Dict of `pairs`, whose keys must be unique."""
    fields = dict(pairs)
    if len(fields) != len(pairs):
        seen: set[str] = set()
        raise _DuplicateKey(next(key for key, _ in pairs if key in seen or seen.add(key)))
    return fields


def load_json(path: Path) -> dict[str, Any]:
    """Returns the object in a JSON file.

    Raises:
        InputError: the file is unreadable, larger than `MAX_BYTES`, not UTF-8 or not JSON, is nested too deeply, has a
            duplicate key, or does not hold an object.
    """
    fields = _load(path)
    if not isinstance(fields, dict):
        got = f"a {type(fields).__name__}"
        raise refusal(str(path), wanted="a JSON object with `frames`", got=got, fix="write the file again")
    return fields


def load_json_list(path: Path) -> list[dict[str, Any]]:
    """Returns the list of objects in a JSON file.

    Raises:
        InputError: as `load_json`, or the file does not hold a list of objects.
    """
    entries = _load(path)
    if not isinstance(entries, list) or not entries or not all(isinstance(entry, dict) for entry in entries):
        got = echo(entries) if isinstance(entries, list) else f"a {type(entries).__name__}"
        raise refusal(str(path), wanted="a JSON list of objects", got=got, fix="write the file again")
    return entries


def _load(path: Path) -> Any:
    """The value in a JSON file."""
    where = str(path)
    text = read_text(path, MAX_BYTES)
    try:
        return json.loads(text, object_pairs_hook=_unique)
    except RecursionError:
        raise refusal(
            where, wanted="JSON of reasonable depth", got="too deep nesting", fix="write the file again"
        ) from None
    except _DuplicateKey as error:
        got = f"{echo(str(error))} twice in one object"
        raise refusal(where, wanted="every key once", got=got, fix="remove one of the two") from None
    except json.JSONDecodeError as error:
        got = f"{error.msg} (line {error.lineno}, column {error.colno})"
        raise refusal(where, wanted="JSON", got=got, fix="write the file again") from None
    except ValueError as error:  # an integer of thousands of digits
        got = echo(str(error))
        raise refusal(
            where, wanted="JSON with numbers of reasonable length", got=got, fix="write the file again"
        ) from None


class JsonFields:
    """Fields of an untrusted JSON object, checked one by one.

    Args:
        fields: the object.
        where: its location for error messages.
    """

    def __init__(self, fields: dict[str, Any], where: str) -> None:
        self._fields, self.where = fields, where

    def has(self, name: str) -> bool:
        """True if there is a value of that name that is not null."""
        return self._fields.get(name) is not None

    def number(self, name: str, default: float | None = None) -> float:
        """Returns a finite number; a missing one is refused if there is no default."""
        value = self._fields.get(name, default)
        try:
            if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
                return float(value)
        except OverflowError:  # an integer too large for float64
            pass
        got = "nothing" if value is None else echo(value)
        raise refusal(f"{self.where}.{name}", wanted="a finite number", got=got, fix="write the file again")

    def numbers(self, name: str, shape: tuple[int, ...]) -> Float64[np.ndarray, "..."]:
        """Returns an array of finite numbers of that shape."""
        value = self._fields.get(name)
        wanted = f"{' x '.join(map(str, shape))} finite numbers"
        try:
            array = np.array(value, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            array = np.zeros(0)
        if array.shape != shape or not np.isfinite(array).all():
            raise refusal(f"{self.where}.{name}", wanted=wanted, got=echo(value), fix="write the file again")
        return array

    def text(self, name: str) -> str:
        """Returns a text that is not empty."""
        value = self._fields.get(name)
        if not isinstance(value, str) or not value:
            got = "nothing" if value is None else echo(value)
            raise refusal(f"{self.where}.{name}", wanted="a text", got=got, fix="write the file again")
        return value
