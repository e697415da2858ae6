"""What a parameter of a Mitsuba scene is, and what transforms and values have in common."""

import difflib
import math
from collections.abc import Sequence
from typing import Any, Protocol

from torch_zerohess.arguments import checked_number

Vector = Sequence[float]
Range = tuple[float, float]

POSITIONS, NORMALS = ".vertex_positions", ".vertex_normals"


class Bound(Protocol):
    """A parameter of a scene that is loaded."""

    n: int
    names: tuple[str, ...]
    labels: list[str]
    x0: list[float]
    limits: list[Range]

    def write(self, values: Any, x: Any) -> None:
        """Give x, a list of n numbers, to the entries `names` of what `mitsuba.traverse` returned.

        A Dr.Jit array [n] instead of the list passes its derivatives on, in variants that have them.
        """


class Parameter(Protocol):
    """A part of x and of the scene."""

    @property
    def names(self) -> tuple[str, ...]: ...

    def bind(self, mi: Any, values: Any) -> Bound:
        """Look the parameter up in a scene that has its names."""


def check_known(names: Sequence[str], known: Sequence[str]) -> None:
    """Raise ValueError for a name that the scene does not have, with names that are near."""
    for name in names:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=3, cutoff=0.4)
            near += [key for key in known if key.split(".")[0] == name.split(".")[0] and key not in near][:3]
            raise ValueError(
                f"the scene has no parameter {name!r}; near ones: {', '.join(near) or ', '.join(known[:8])}"
            )


def assign(values: Any, name: str, value: Any) -> None:
    """Give an entry its value, so that the normals of a mesh depend on the values alone.

    Mitsuba recomputes the normals of a mesh whose vertices change, unless its normals change too. To scalar variants an
    equal value is no change.
    """
    values[name] = value
    if name.endswith((POSITIONS, NORMALS)):
        values.set_dirty(name)


def elements(mi: Any, x: Any, n: int) -> list[Any]:
    """Dr.Jit numbers of a Dr.Jit array x [n]."""
    import drjit

    return [drjit.gather(mi.Float, x, i) for i in range(n)]


def ranges(name: str, bounds: Range | Sequence[Range] | None, n: int) -> list[Range]:
    """Return n pairs of a lower and an upper bound."""
    if bounds is None:
        return [(-math.inf, math.inf)] * n
    given: Any = plain(bounds)
    several = given if is_list(given) and any(is_list(one) for one in given) else [given] * n
    if len(several) != n or not all(is_list(one) and len(one) == 2 for one in several):
        raise ValueError(f"bounds of {name} must be a pair (lower, upper) or {n} of them, got {given!r}")
    low_high = [[checked_number(f"bounds of {name}", end) for end in one] for one in several]
    pairs = [(low, high) for low, high in low_high]
    for low, high in pairs:
        if not low < high:
            raise ValueError(f"bounds of {name} must be lower < upper, got {low:g}, {high:g}")
    return pairs


def plain(value: Any) -> Any:
    """Return arrays and tensors as numbers or lists of numbers; also those in a list, whose kind stays."""
    if hasattr(value, "tolist"):
        return value.tolist()
    if not hasattr(value, "__len__") or isinstance(value, (str, bytes, dict)):
        return value
    rows = [plain(one) for one in value]
    return tuple(rows) if isinstance(value, tuple) else rows


def is_list(value: Any) -> bool:
    """Whether a value that `plain` returned is several numbers."""
    return isinstance(value, (list, tuple))
