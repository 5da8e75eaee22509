"""Strict JSON output: NaN and infinity, which JSON does not have, are written as null."""

import json
import math
import os
from typing import Any

from ssplat_jax.core.atomic import write_atomic


def json_text(value: Any, indent: int | None = 1) -> str:
    """Returns `value` as JSON text; NaN and infinities become null."""
    return json.dumps(_finite(value), indent=indent, allow_nan=False)


def write_json(path: str | os.PathLike, value: Any) -> None:
    """Writes `value` to `path` as indented JSON, atomically.

    Raises:
        StorageError: the file cannot be written.
    """
    write_atomic(path, (json_text(value) + "\n").encode())


def _finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _finite(x) for key, x in value.items()}
    return [_finite(x) for x in value] if isinstance(value, (list, tuple)) else value
