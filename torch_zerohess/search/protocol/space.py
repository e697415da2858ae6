"""The parameters of a search: their bounds and type, and the units of sigma in which every search works."""

import math
import reprlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from torch_zerohess.arguments import own_copy
from torch_zerohess.estimation.inputs import check_no_derivative, short, working


class Array(Protocol):
    """An array of NumPy, or what can be made one."""

    def __array__(self, *args: Any, **kwargs: Any) -> Any: ...


class BothBounds(Protocol):
    """`scipy.optimize.Bounds`."""

    @property
    def lb(self) -> Any: ...

    @property
    def ub(self) -> Any: ...


Vector = Sequence[float] | Tensor | Array
"""Numbers [n]."""
Bound = float | Sequence[float | None] | Tensor | Array | None
Bounds = tuple[Bound, Bound] | Sequence[Sequence[float | None]] | Tensor | Array | BothBounds
"""(lower, upper), numbers or [n] or None; n pairs (lower, upper), a list or [n, 2]; or `scipy.optimize.Bounds`."""


@dataclass(frozen=True, eq=False)
class Space:
    """Parameters x [n], and their coordinates z = x / unit [n], float64, in which every sigma is 1."""

    start: Tensor
    """x0 [n], in the type of the parameters."""
    unit: Tensor
    """The first sigma of every parameter [n], float64; at most the distance between its bounds."""
    lower: Tensor
    """Bounds [n] in the type of the parameters; infinite where there are none."""
    upper: Tensor

    @classmethod
    def checked(cls, x0: Tensor, sigma: float | Vector, bounds: Bounds | None) -> "Space":
        """Check what a caller gave. ValueError for a wrong shape or type, or a number out of range."""
        lower, upper = _bounds(bounds, x0)
        width, unit = upper.double() - lower.double(), _unit(sigma, x0)
        unit = torch.where(width > 0, unit.minimum(width), unit)  # a wider one would make all of the box one point
        return cls(x0.detach().clamp(lower, upper), unit, lower, upper)

    def check_state(self, state: Mapping[str, Any]) -> None:
        """Raise ValueError for the state of a search with other parameters, another sigma or other bounds."""
        unit = state["unit"].to(self.unit)
        if len(unit) != len(self.unit):
            raise ValueError(f"state must be of a search with {len(self.unit)} parameters, got one with {len(unit)}")
        if not bool((unit == self.unit).all()):
            raise ValueError(f"state must be of a search with sigma = {self.unit.tolist()}, got {unit.tolist()}")
        for name, own in (("lower", self.lower), ("upper", self.upper)):
            if not torch.equal(state[name].to(own), own):
                raise ValueError(
                    f"state must be of a search with {name} bounds {own.tolist()}, got {state[name].tolist()}"
                )

    def checked_points(self, points: Any, name: str = "points") -> Tensor:
        """Return points [K, n] of the caller's as a tensor. ValueError if a search could not have asked for them."""
        n = len(self.start)
        try:
            points = torch.as_tensor(points, device=self.unit.device).double()
        except (TypeError, ValueError, RuntimeError) as error:
            raise ValueError(f"{name} must be numbers [K, {n}], got {reprlib.repr(points)}") from error
        if points.ndim != 2 or points.shape[1] != n or not len(points):
            raise ValueError(f"{name} must have shape [K, {n}], got {list(points.shape)}")
        lower, upper, infinite = self.lower, self.upper, torch.full_like(self.upper, math.inf)
        if lower.dtype == torch.float32:  # the bound 0.3 is no number of float32, and may be a point of float64
            lower, upper = lower.nextafter(-infinite), upper.nextafter(infinite)
        wrong = ~((points >= lower) & (points <= upper) & torch.isfinite(points)).all(1)
        if bool(wrong.any()):
            k = int(wrong.nonzero()[0])
            raise ValueError(f"{name} must be finite and within the bounds, got {points[k].tolist()} for point {k}")
        return points.detach().clamp(self.lower.double(), self.upper.double())

    def start_first(self, points: Tensor) -> Tensor:
        """Return the order [K] of points [K, n] in which the start is the first. ValueError if it is none of them."""
        found = (points.to(self.start.dtype) == self.start).all(1)
        if not bool(found.any()):
            raise ValueError(
                f"points must have the start x0 = {short(self.start)} among them, with which the search begins, got "
                f"{len(points)} others: make the search with one of them as x0, the best one, or evaluate x0, too"
            )
        order = torch.arange(len(points), device=points.device)
        return torch.cat([order[found][:1], order[order != order[found][0]]])

    def coordinates(self, x: Tensor) -> Tensor:
        """Coordinates of parameters x, float64."""
        return x.double() / self.unit

    def parameters(self, z: Tensor) -> Tensor:
        """Parameters of coordinates z, in the type of x0. Rounding does not leave the bounds, nor change the start."""
        x = (z * self.unit).to(self.start.dtype).clamp(self.lower, self.upper)
        return torch.where(z == self.coordinates(self.start), self.start, x)

    def rounded(self, z: Tensor) -> Tensor:
        """Coordinates of the parameters that are evaluated for z: those that the type of x0 has."""
        return z if self.start.dtype == torch.float64 else self.coordinates(self.parameters(z))


def checked_start(x0: Any) -> Tensor:
    """Return a start as a tensor [n], float32 or float64. ValueError if it is not finite, or no real numbers.

    float16 and bfloat16 of torch become float32. A NumPy array of float32 or float64 keeps its type. Lists, tuples and
    integers of NumPy or torch become float64.
    """
    if not isinstance(x0, Tensor):
        kept = str(getattr(x0, "dtype", "")) in ("float32", "complex64", "complex128")
        try:
            x0 = torch.as_tensor(own_copy(x0), dtype=None if kept else torch.float64)
        except (TypeError, ValueError, RuntimeError) as error:
            raise ValueError(f"x0 must be a tensor, an array or a list of n numbers, got {x0!r}") from error
    elif not x0.is_floating_point() and not x0.is_complex():
        x0 = x0.double()
    check_no_derivative("what a search finds has no graph: pass x0.detach()", x0=x0)
    x0 = working(x0)
    if x0.dtype not in (torch.float32, torch.float64) or x0.ndim != 1 or not len(x0):
        raise ValueError(f"x0 must be a tensor [n], float32 or float64, got one of shape {[*x0.shape]}, {x0.dtype}")
    if not bool(torch.isfinite(x0).all()):
        raise ValueError(f"x0 must be finite, got {reprlib.repr(x0.tolist())}")
    return x0


def _unit(sigma: float | Vector, x0: Tensor) -> Tensor:
    """Return sigma as float64 [n]."""
    try:
        unit = torch.as_tensor(own_copy(sigma), dtype=torch.float64, device=x0.device).detach()
    except (TypeError, ValueError, RuntimeError) as error:
        raise TypeError(f"sigma must be a number, or one per parameter [{len(x0)}], got {sigma!r}") from error
    if unit.shape not in ((), x0.shape) or not bool((torch.isfinite(unit) & (unit > 0)).all()):
        raise ValueError(f"sigma must be positive and finite, one value or one per parameter [{len(x0)}], got {sigma}")
    start = x0.detach()
    if bool((start + unit.to(x0.dtype) == start).any()):
        raise ValueError(f"sigma must be large enough to change x0 in {x0.dtype}, got {sigma} for {start}")
    return unit.expand_as(x0).clone()


def _bounds(bounds: Bounds | None, x0: Tensor) -> tuple[Tensor, Tensor]:
    """Return lower and upper [n], the outermost numbers within the bounds that the type of x0 has."""
    if bounds is None:
        infinite = torch.full_like(x0.detach(), math.inf)
        return -infinite, infinite
    sides = zip(_sides(bounds, len(x0)), (-math.inf, math.inf), strict=True)
    lower, upper = (_side(one, none, x0.device).detach() for one, none in sides)
    for name, one in (("lower", lower), ("upper", upper)):
        if one.shape not in ((), x0.shape):
            raise ValueError(f"the {name} bound must be a number or [{len(x0)}], got shape {list(one.shape)}")
    lower, upper = lower.expand_as(x0), upper.expand_as(x0)
    if not bool((lower < upper).all()):
        k = int((~(lower < upper)).nonzero()[0])
        low, high = float(lower[k]), float(upper[k])
        hold = f"torch.cat([x[:, :{k}], torch.full_like(x[:, :1], {low}), x[:, {k}:]], 1)"
        held = f": to hold the parameter at {low}, leave it out of x0, and call fn({hold})" if low == high else ""
        raise ValueError(f"bounds must have lower < upper, got {low} and {high} at index {k}{held}")
    start, inner = x0.detach(), (lower.to(x0.dtype), upper.to(x0.dtype))
    within = (start >= inner[0]) & (start <= inner[1])  # 0.3 is no number of float32, and may be start and bound
    if not bool(within.all()):
        k = int((~within).nonzero()[0])
        raise ValueError(
            f"x0 must be within the bounds, got {float(start[k])} at index {k}, outside of "
            f"[{float(lower[k])}, {float(upper[k])}]"
        )
    infinite = torch.full_like(inner[0], math.inf)
    return (
        torch.where(inner[0].double() < lower, inner[0].nextafter(infinite), inner[0]),
        torch.where(inner[1].double() > upper, inner[1].nextafter(-infinite), inner[1]),
    )


def _sides(bounds: Any, n: int) -> tuple[Any, Any]:
    """Return lower and upper of bounds in any form; ValueError if two forms are possible.

    A list of tuples is a list of pairs. An array or tensor is read as the list of its rows. Two rows of two numbers are
    taken where only one reading has lower < upper, or both are the same. A tuple of two lists is never taken for pairs.
    """
    if hasattr(bounds, "lb") and hasattr(bounds, "ub"):  # scipy.optimize.Bounds, which makes arrays [1] of numbers
        lower, upper = (one.item() if getattr(one, "size", 0) == 1 else one for one in (bounds.lb, bounds.ub))
        return lower, upper
    if hasattr(bounds, "tolist"):
        bounds = bounds.tolist()
    if isinstance(bounds, str) or not hasattr(bounds, "__iter__"):
        raise TypeError(f"bounds must be (lower, upper) or a list of {n} pairs, got {bounds!r}")
    if not isinstance(bounds, (tuple, list)):
        bounds = tuple(bounds)
    sides = isinstance(bounds, tuple) and len(bounds) == 2 and all(isinstance(one, list) for one in bounds)
    pairs = len(bounds) == n and all(isinstance(one, (tuple, list)) and len(one) == 2 for one in bounds)
    columns = [list(one) for one in zip(*bounds, strict=True)] if pairs else []
    if pairs and isinstance(bounds, list) and all(isinstance(one, tuple) for one in bounds):
        return columns[0], columns[1]
    rows = [list(one) for one in bounds] if pairs else []
    if pairs and n == 2 and rows != columns and _in_order(*rows) and _in_order(*columns):
        as_pairs, as_sides = ([tuple(one) for one in each] for each in (rows, columns))
        raise ValueError(
            f"bounds of 2 parameters can be read in two ways, got {bounds}: write {as_pairs} if each parameter has a "
            f"pair, or {as_sides} if lower = {rows[0]} and upper = {rows[1]}"
        )
    if pairs and (n != 2 or not (sides or _in_order(*rows))):
        return columns[0], columns[1]
    if len(bounds) != 2:
        raise ValueError(f"bounds must be (lower, upper) or a list of {n} pairs, got {len(bounds)} entries")
    return bounds[0], bounds[1]


def _in_order(lower: Any, upper: Any) -> bool:
    """Whether lower < upper, element by element, where neither is None."""
    return all(a is None or b is None or a < b for a, b in zip(lower, upper, strict=True))


def _side(one: Any, none: float, device: torch.device) -> Tensor:
    """Return a bound as float64; `none` where there is none."""
    try:
        if isinstance(one, (tuple, list)):
            one = [none if each is None else float(each) for each in one]
        return torch.as_tensor(none if one is None else own_copy(one), dtype=torch.float64, device=device)
    except (TypeError, ValueError, RuntimeError) as error:
        raise TypeError(f"bounds must be numbers, tensors [n] or None, got {one!r}") from error
