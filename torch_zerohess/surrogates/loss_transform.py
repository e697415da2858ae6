"""Transforms of a loss that may bring it closer to a quadratic: squares and logarithms (Box and Cox 1964).

The root of a mean square is a cone at its minimum, but its square is a quadratic. Sums of exponentials or of fourth
powers grow so steeply that their logarithm is closer to a quadratic.

Losses v >= 0 above the lowest one become ((v + c)^2 - c^2) / (2 c) or c log(1 + v / c), with a shift c > 0. Both are
about v where v is far below c, and both rise with v: the minimum stays where it is. Kind and shift are chosen by the
likelihood of the losses. The likelihood of a loss is the likelihood of its transform times the slope there.
"""

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

_SHIFTS = tuple(20.0 * 1.5**-k for k in range(30))
"""Shifts to choose from, over the largest value."""
_HIGHEST = 50.0
"""Logarithm of the largest loss over the shift that is predicted."""


@dataclass(frozen=True)
class LossTransform:
    """A transform of losses above the lowest one."""

    kind: Literal["square", "logarithm"]
    shift: float
    """c, in units of the losses; above 0."""

    def inverse(self, y: float) -> float:
        """Return the loss above the lowest one; minus the shift where a quadratic predicts less than any square."""
        if self.kind == "logarithm":
            return self.shift * math.expm1(min(y / self.shift, _HIGHEST))
        return math.sqrt(max(self.shift * (self.shift + 2.0 * y), 0.0)) - self.shift

    def hessian_ratio(self, other: "LossTransform") -> float:
        """Return a Hessian under this transform over the same under the other one; 1 unless both are squares."""
        return other.shift / self.shift if self.kind == other.kind == "square" else 1.0


def transformed(values: Tensor) -> tuple[list[LossTransform], Tensor, Tensor]:
    """Return the transforms to choose from, transformed losses, and the mean log slope of each transform.

    Args:
        values: losses [P] above the lowest one, which is 0; the largest is of the order of 1.

    Returns:
        Transforms, losses [P, T], and means [T] over all losses but the lowest one, where every slope is 1.
    """
    shifts = torch.tensor(_SHIFTS, dtype=values.dtype, device=values.device)
    v = values[:, None]
    squares, logarithms = v + v.square() / (2.0 * shifts), shifts * (v / shifts).log1p()
    slopes = (v / shifts).log1p().sum(0) / max(len(v) - 1, 1)
    kinds: tuple[Literal["square", "logarithm"], ...] = ("square", "logarithm")
    transforms = [LossTransform(kind, shift) for kind in kinds for shift in _SHIFTS]
    return transforms, torch.cat([squares, logarithms], 1), torch.cat([slopes, -slopes])


def warped(values: Tensor, unit: float) -> tuple[Tensor, Tensor]:
    """Return u asinh(v / u), which is v up to about the unit u and a logarithm beyond, and its slopes.

    Noise of low values keeps its standard deviation. Noise of high values becomes smaller, as values do.

    Args:
        values: losses v [P], in noise some are below 0.
        unit: u, above 0; infinity returns the values.

    Returns:
        Values and slopes [P].
    """
    if unit == math.inf:
        return values, torch.ones_like(values)
    scaled = values / unit
    return unit * scaled.asinh(), scaled.square().add(1.0).rsqrt()
