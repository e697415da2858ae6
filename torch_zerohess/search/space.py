"""The parameters of a search: their bounds and type, and the units of sigma in which every search works."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

Bounds = tuple[float | Tensor, float | Tensor]
"""Lower and upper, numbers or [n]."""


@dataclass(frozen=True, eq=False)
class Space:
    """Parameters x [n], and their coordinates z = x / unit [n], float64, in which every sigma is 1."""

    start: Tensor
    """x0 [n], in the type of the parameters."""
    unit: Tensor
    """The first sigma of every parameter [n], float64."""
    lower: Tensor
    """Bounds [n] in the type of the parameters; infinite where there are none."""
    upper: Tensor

    @classmethod
    def checked(
        cls, x0: Tensor, sigma: float | Tensor, bounds: tuple[float | Tensor, float | Tensor] | None
    ) -> "Space":
        """Check what a caller gave. ValueError for a wrong shape or type, or a number out of range."""
        return cls(x0.detach().clone(), _unit(sigma, x0), *_bounds(bounds, x0))

    def coordinates(self, x: Tensor) -> Tensor:
        """Coordinates of parameters x, float64."""
        return x.double() / self.unit

    def parameters(self, z: Tensor) -> Tensor:
        """Parameters of coordinates z, in the type of x0. Rounding does not leave the bounds."""
        return (z * self.unit).to(self.start.dtype).clamp(self.lower, self.upper)

    def rounded(self, z: Tensor) -> Tensor:
        """Coordinates of the parameters that are evaluated for z: those that the type of x0 has."""
        return z if self.start.dtype == torch.float64 else self.coordinates(self.parameters(z))


def check_start(x0: Tensor) -> None:
    """Raise ValueError for a start that is not a finite tensor [n], float32 or float64."""
    if not isinstance(x0, Tensor) or x0.dtype not in (torch.float32, torch.float64) or x0.ndim != 1 or not len(x0):
        raise ValueError(f"x0 must be a tensor [n], float32 or float64, got {x0!r}")
    if not bool(torch.isfinite(x0).all()):
        raise ValueError(f"x0 must be finite, got {x0}")


def _unit(sigma: float | Tensor, x0: Tensor) -> Tensor:
    """Return sigma as float64 [n]."""
    unit = torch.as_tensor(sigma, dtype=torch.float64, device=x0.device).detach()
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
    if len(bounds) != 2:
        raise ValueError(f"bounds must be (lower, upper), got {len(bounds)} entries")
    lower, upper = (torch.as_tensor(one, dtype=torch.float64, device=x0.device).detach() for one in bounds)
    for name, one in (("lower", lower), ("upper", upper)):
        if one.shape not in ((), x0.shape):
            raise ValueError(f"the {name} bound must be a number or [{len(x0)}], got shape {list(one.shape)}")
    lower, upper = lower.expand_as(x0), upper.expand_as(x0)
    if not bool((lower < upper).all()):
        k = int((~(lower < upper)).nonzero()[0])
        raise ValueError(f"bounds must have lower < upper, got {float(lower[k])} and {float(upper[k])} at index {k}")
    start = x0.detach().double()
    if not bool(((start >= lower) & (start <= upper)).all()):
        k = int(((start < lower) | (start > upper)).nonzero()[0])
        raise ValueError(
            f"x0 must be within the bounds, got {float(start[k])} at index {k}, outside of "
            f"[{float(lower[k])}, {float(upper[k])}]"
        )
    inner = lower.to(x0.dtype), upper.to(x0.dtype)
    infinite = torch.full_like(inner[0], math.inf)
    return (
        torch.where(inner[0].double() < lower, inner[0].nextafter(infinite), inner[0]),
        torch.where(inner[1].double() > upper, inner[1].nextafter(-infinite), inner[1]),
    )
