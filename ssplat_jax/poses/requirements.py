"""Optional packages of this command, imported when they are needed."""

import importlib
from typing import Any

from ssplat_jax.core.errors import InputError

INSTALL = 'pip install -e ".[poses]"'


def require(name: str) -> Any:
    """Returns the package `name`.

    Raises:
        InputError: it is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise InputError(f"poses: wanted the package {name}, which is not installed; run: {INSTALL}") from error
