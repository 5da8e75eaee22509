"""JSON from outside: size and nesting bounded, no duplicate keys, UTF-8. NaN and Infinity are let through as floats,
so that the field that holds them can be named."""

import json
from pathlib import Path
from typing import Any

from ssplat_jax.errors import echo, refusal

MAX_BYTES = 256 << 20


class _DuplicateKey(ValueError):
    pass


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    fields = dict(pairs)
    if len(fields) != len(pairs):
        seen: set[str] = set()
        raise _DuplicateKey(next(key for key, _ in pairs if key in seen or seen.add(key)))
    return fields


def load_json(path: Path) -> dict[str, Any]:
    """The object in the file.

    Raises:
        InputError: unreadable, larger than 256 MiB, not UTF-8, not JSON, nested too deeply, a key twice, no object.
    """
    where = str(path)
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise refusal(where, wanted=f"at most {MAX_BYTES:,} bytes", got=f"{size:,}", fix="split the capture")
        fields = json.loads(path.read_bytes().decode("utf-8-sig"), object_pairs_hook=_unique)
    except OSError as error:
        fix = "check that the file exists and may be read"
        raise refusal(where, wanted="a readable file", got=error.strerror, fix=fix) from None
    except UnicodeDecodeError as error:
        got = f"byte {error.object[error.start]:#04x} at {error.start}"
        raise refusal(where, wanted="UTF-8 text", got=got, fix="save the file as UTF-8") from None
    except RecursionError:
        raise refusal(where, wanted="JSON of sane depth", got="endless nesting", fix="write the file anew") from None
    except _DuplicateKey as error:
        got = f"{echo(str(error))} twice in one object"
        raise refusal(where, wanted="every key once", got=got, fix="remove one of the two") from None
    except json.JSONDecodeError as error:
        got = f"{error.msg} (line {error.lineno}, column {error.colno})"
        raise refusal(where, wanted="JSON", got=got, fix="write the file anew") from None
    except ValueError as error:  # an integer of thousands of digits
        got = echo(str(error))
        raise refusal(where, wanted="JSON with numbers of sane length", got=got, fix="write the file anew") from None
    if not isinstance(fields, dict):
        got = f"a {type(fields).__name__}"
        raise refusal(where, wanted="a JSON object with `frames`", got=got, fix="write the file anew")
    return fields
