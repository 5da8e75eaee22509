"""Reader of untrusted JSON: bounded size and nesting, UTF-8, no duplicate keys.

NaN and Infinity are accepted as floats, so that a later check can name the field that holds them.
"""

import json
from pathlib import Path
from typing import Any

from ssplat_jax.data.readers.strict_text import read_text
from ssplat_jax.errors import echo, refusal

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
    where = str(path)
    text = read_text(path, MAX_BYTES)
    try:
        fields = json.loads(text, object_pairs_hook=_unique)
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
    if not isinstance(fields, dict):
        got = f"a {type(fields).__name__}"
        raise refusal(where, wanted="a JSON object with `frames`", got=got, fix="write the file again")
    return fields
