"""What the program says about itself, as JSON that every reader takes: a number that is not finite is null."""

import json
import math
import os
from typing import Any

from ssplat_jax.storage.atomic import write_atomic


def json_text(value: Any, indent: int | None = 1) -> str:
    """`value` as JSON; NaN and infinities, which JSON does not have, as null."""
    return json.dumps(_finite(value), indent=indent, allow_nan=False)


def write_json(path: str | os.PathLike, value: Any) -> None:
    """Puts `value` at `path` as indented JSON, whole or not at all.

    Raises:
        StorageError: see `write_atomic`.
    """
    write_atomic(path, (json_text(value) + "\n").encode())


def _finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _finite(x) for key, x in value.items()}
    return [_finite(x) for x in value] if isinstance(value, (list, tuple)) else value
