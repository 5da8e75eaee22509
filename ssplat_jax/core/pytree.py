"""Frozen dataclasses that are pytrees, type-checked when built by hand but not when a transform rebuilds them."""

import dataclasses
from typing import Any, TypeVar, dataclass_transform

import jax

T = TypeVar("T")


def static(**kwargs: Any) -> Any:
    """A dataclass field that is part of the tree's structure: changing it recompiles."""
    return dataclasses.field(metadata={"static": True}, **kwargs)


@dataclass_transform(frozen_default=True, field_specifiers=(dataclasses.field, static))
def pytree(cls: type[T]) -> type[T]:
    """Makes `cls` a frozen dataclass and registers it with JAX.

    Fields are leaves in declaration order, except those declared with `static()`. Building an instance by hand runs
    `__init__`, and with it the type checks that the tests switch on. Transforms bypass it, because they put tracers,
    `None`, shardings and batched arrays where arrays are annotated. Printed, an array is its dtype and shape.
    """
    has_own = "__repr__" in vars(cls)
    cls = dataclasses.dataclass(frozen=True, repr=False)(cls)
    if not has_own:
        setattr(cls, "__repr__", _summary)  # noqa: B010 - the types of the two differ in the name of their argument
    fields = dataclasses.fields(cls)  # pyright: ignore[reportArgumentType]
    leaf_names = [f.name for f in fields if not f.metadata.get("static")]
    static_names = [f.name for f in fields if f.metadata.get("static")]

    def flatten(x: T):
        return [getattr(x, n) for n in leaf_names], tuple(getattr(x, n) for n in static_names)

    def flatten_with_keys(x: T):
        leaves, aux = flatten(x)
        return [(jax.tree_util.GetAttrKey(n), leaf) for n, leaf in zip(leaf_names, leaves, strict=True)], aux

    def unflatten(aux, leaves) -> T:
        x = object.__new__(cls)
        for name, value in (*zip(leaf_names, leaves, strict=True), *zip(static_names, aux, strict=True)):
            object.__setattr__(x, name, value)
        return x

    jax.tree_util.register_pytree_with_keys(cls, flatten_with_keys, unflatten, flatten)
    return cls


def _summary(x: Any) -> str:
    """The fields of a dataclass; arrays by dtype and shape, since those of a scene are too long to print."""
    parts = []
    for field in dataclasses.fields(x):
        value = getattr(x, field.name)
        is_array = hasattr(value, "shape") and hasattr(value, "dtype")
        parts.append(f"{field.name}={f'{value.dtype}{list(value.shape)}' if is_array else repr(value)}")
    return f"{type(x).__name__}({', '.join(parts)})"


def replace(x: T, **changes: Any) -> T:
    """A copy of the dataclass instance `x` with `changes` applied."""
    return dataclasses.replace(x, **changes)  # pyright: ignore[reportArgumentType]
