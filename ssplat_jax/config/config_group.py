"""Base of the groups of configuration fields, and checks that they share."""

import dataclasses
import math
from typing import Any, Literal, get_args, get_origin

from ssplat_jax.core.errors import InputError


def is_positive(value: Any) -> bool:
    """True for a finite number above 0."""
    return isinstance(value, int | float) and 0 < value < math.inf


def is_range(value: Any) -> bool:
    """True for None and for two positive numbers, the smaller first."""
    return value is None or (len(value) == 2 and all(map(is_positive, value)) and value[0] < value[1])


def are_widths(value: Any) -> bool:
    """True for two widths of at least 1, the second even."""
    is_good = len(value) == 2 and all(isinstance(width, int) and width >= 1 for width in value)
    return is_good and value[1] % 2 == 0  # the position code has pairs of a sine and a cosine


class ConfigGroup:
    """Base of the groups of fields; `__post_init__` checks every field. Lists become tuples, which have a hash."""

    def rules(self) -> tuple[tuple[str, str, bool], ...]:
        """Rules beyond the options of a field: (field, wanted, whether its value is good)."""
        return ()

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):  # pyright: ignore[reportArgumentType]
            if isinstance(value := getattr(self, field.name), list):
                object.__setattr__(self, field.name, tuple(value))
        for name, wanted, is_good in self.rules():
            if not is_good:
                raise InputError(f"config: {name} must be {wanted}, got {getattr(self, name)!r}.")
        for field in dataclasses.fields(self):  # pyright: ignore[reportArgumentType]
            options = get_args(field.type) if get_origin(field.type) is Literal else ()
            if options and getattr(self, field.name) not in options:
                wanted = ", ".join(map(repr, options))
                raise InputError(f"config: {field.name} must be one of {wanted}, got {getattr(self, field.name)!r}.")
