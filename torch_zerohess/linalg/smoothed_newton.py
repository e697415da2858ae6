"""Minimum of a loss with kinks, of outputs that are linear in the parameters, within a ball and a box.

Newton's method on smoothed losses, with ever less smoothing. A loss at an output y [m] is smoothed by its mean over
points y + o, with offsets o_i evenly spread up to the width w_i of element i. The second derivative by y_i is the slope
of the regression line of the slopes on o_i. So all second derivatives but the diagonal count as zero. This is right for
a sum over elements, and costs further steps elsewhere. At a kink the second derivative is about 1 / w_i. An element
keeps the largest second derivative of all widths so far, as in iteratively reweighted least squares. The loss and its
slope are evaluated some hundred times.

Source: Chen (2012), "Smoothing methods for nonsmooth, nonconvex minimization".
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torch_zerohess.linalg.krylov import are_free, krylov_steps

_OFFSETS = 8
"""Points of a mean."""
_GOLDEN = 0.6180339887498949
"""Offset from one element to the next, so that elements do not share their points."""
_LEVELS, _FACTOR = 12, 0.25
"""Widths, and each one over the one before."""
_STEPS = 4
"""Newton steps with one width."""
_SMALL = 0.01
"""Decrease of a step, over all of it so far, after which the width is reduced."""
_GAIN, _IDLE = 1e-3, 2
"""Widths in a row that add less than this share of the decrease so far, after which it ends."""
_PRODUCTS = 100
"""Products of the Hessian for a step."""
_DECREASE, _HALVINGS = 1e-2, 12
"""Part of the decrease that the slope promises, and halvings of a step until it achieves that."""


@dataclass(frozen=True, eq=False)
class LinearOutputs:
    """Outputs [m] that are linear in the parameters s [n], and their loss."""

    loss: Callable[[Tensor], tuple[float, Tensor]]
    """Maps outputs [m] to a value and a slope [m]."""
    output: Tensor
    """At s = 0 [m]."""
    matvec: Callable[[Tensor], Tensor]
    """Jacobian times s, [n] -> [m]."""
    rmatvec: Callable[[Tensor], Tensor]
    """[m] -> [n]."""

    def value(self, s: Tensor) -> float:
        """Return the loss at s [n]."""
        return self.loss(self.output + self.matvec(s))[0]


class _Smoothed(NamedTuple):
    """A smoothed loss at one output: its value, its slope [m], and its second derivatives [m]."""

    value: float
    slope: Tensor
    curvature: Tensor


def smoothed_minimum(
    outputs: LinearOutputs, widths: Tensor, radius: float, lower: Tensor, upper: Tensor, start: Tensor
) -> tuple[Tensor, float]:
    """Return the lowest s [n] that is found, and how far its loss is below the loss at s = 0; zeros if none is lower.

    Args:
        outputs: with a loss that should be convex.
        widths: how far outputs change within the ball [m], at the least; not negative.
        radius: of the ball around s = 0.
        lower: bounds of s [n], at most 0.
        upper: at least 0.
        start: [n], within ball and box.
    """
    zero = torch.zeros_like(start)
    best, first = zero, outputs.value(zero)
    lowest, s, idle, floor = first, zero, 0, torch.zeros_like(widths)
    if (value := outputs.value(start)) < first:
        best, lowest, s = start, value, start
    known = lowest
    for level in range(_LEVELS):
        before, width = lowest, widths * _FACTOR**level
        now = _smoothed(outputs, s, width)
        for _ in range(_STEPS):
            step = _newton(outputs, s, now, torch.maximum(now.curvature, floor), radius, lower, upper)
            after = _descended(outputs, s, now, step, width)
            if after is None:
                break
            gain = now.value - after[1].value
            s, now = after
            if (value := outputs.value(s)) < lowest:
                best, lowest = s, value
            if not gain > _SMALL * (first - lowest):
                break
        floor = torch.maximum(floor, now.curvature)
        idle = idle + 1 if before - lowest <= _GAIN * (first - lowest) else 0
        if lowest < known and idle >= _IDLE:  # the minimum with much smoothing may be above the start
            break
    return best, first - lowest


def _newton(
    outputs: LinearOutputs, s: Tensor, now: _Smoothed, curvature: Tensor, radius: float, lower: Tensor, upper: Tensor
) -> Tensor:
    """Return the step from s [n] to the minimum of a quadratic within ball and box; held parameters stay."""
    slope = outputs.rmatvec(now.slope)
    free = are_free(s, slope, lower, upper)

    def product(v: Tensor) -> Tensor:
        return free * outputs.rmatvec(curvature * outputs.matvec(free * v))

    end = krylov_steps(product, free * slope - product(s), slope.new_tensor([radius]), iterations=_PRODUCTS)[0]
    return free * (end.clamp(lower, upper) - s)


def _descended(
    outputs: LinearOutputs, s: Tensor, now: _Smoothed, step: Tensor, width: Tensor
) -> tuple[Tensor, _Smoothed] | None:
    """Return the point along a step that lowers the smoothed loss enough, and this loss; None if there is none."""
    down = float(outputs.rmatvec(now.slope) @ step)
    if not down < 0.0:
        return None
    for halving in range(_HALVINGS):
        length = 0.5**halving
        after = _smoothed(outputs, s + length * step, width)
        if after.value <= now.value + _DECREASE * length * down:
            return s + length * step, after
    return None


def _smoothed(outputs: LinearOutputs, s: Tensor, width: Tensor) -> _Smoothed:
    y = outputs.output + outputs.matvec(s)
    element = torch.arange(len(y), dtype=y.dtype, device=y.device)
    value, slope, product, square = 0.0, torch.zeros_like(y), torch.zeros_like(y), torch.zeros_like(y)
    for k in range(_OFFSETS):
        offset = width * (2.0 * ((_GOLDEN * element + (k + 0.5) / _OFFSETS) % 1.0) - 1.0)
        one, steep = outputs.loss(y + offset)
        value, slope = value + one / _OFFSETS, slope + steep / _OFFSETS
        product, square = product + offset * steep, square + offset.square()
    return _Smoothed(value, slope, torch.nan_to_num(product / square, posinf=0.0).clamp_min(0.0))
