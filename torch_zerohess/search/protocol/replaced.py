"""Copies of a progress with other fields. A step of a search makes some twenty of them."""

import dataclasses
import functools
from typing import Any, TypeVar

T = TypeVar("T")


def replace(known: T, **changes: Any) -> T:
    """Return a copy of a dataclass without `__post_init__` with other fields; TypeError for a field that it lacks.

    `dataclasses.replace` does the same by a call of `__init__`, and takes four times as long: 10 microseconds for a
    progress of 40 fields. Steps of two parameters by a loss alone would take 4 % longer. Cached properties are not
    copied.
    """
    kind, kept = type(known), vars(known)
    names = _names(kind)  # type: ignore[arg-type]  # a class is hashable
    if not changes.keys() <= names:
        raise TypeError(f"{kind.__name__} has no field {', '.join(sorted(changes.keys() - names))}")
    made = object.__new__(kind)
    vars(made).update({name: kept[name] for name in names}, **changes)
    return made


@functools.cache
def _names(kind: type[Any]) -> frozenset[str]:
    """Return the names of the fields; ValueError if `__init__` does more than to set them."""
    fields = dataclasses.fields(kind)
    if hasattr(kind, "__post_init__") or not all(one.init for one in fields):
        raise ValueError(f"{kind.__name__} must have no __post_init__, and no field that __init__ does not take")
    return frozenset(one.name for one in fields)
