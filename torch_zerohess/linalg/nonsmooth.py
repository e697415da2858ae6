"""Minimum of a function with kinks whose slope is known, such as a sum of magnitudes."""

from collections.abc import Callable

import torch
from torch import Tensor

Valued = Callable[[Tensor], tuple[float, Callable[[], Tensor]]]
"""Maps [n], float64, to a value and to a function that computes a slope [n] there. Many points of a line search need no
slope."""

_DECREASE, _SLOPE = 1e-4, 0.9
"""Part of the decrease that the slope promises, and part of the slope, of a line search: conditions of Wolfe."""
_BISECTIONS = 30
"""Points of a line search at most."""
_LATEST = 10
"""Iterations whose decrease is compared with the whole decrease."""
_ITERATIONS, _LEAST_GAIN, _BESIDE = 1000, 1e-6, 0.01
"""Of several tries in a box: iterations, least gains, and the distance of their starts over the radius."""


def kinked_minimum(
    function: Valued,
    start: Tensor,
    iterations: int,
    radius: float,
    least_gain: float = 0.0,
) -> Tensor:
    """Return the lowest point [n] that BFGS finds from `start` [n].

    At a kink the line search, a bisection, ends with a slope of the other side. So BFGS learns the kink as a large
    curvature. The function need not be convex. Convergence is not proven.

    Args:
        function: returns a value and the function of its slope.
        start: its value is finite.
        iterations: at most.
        radius: length of the first step that is tried. The path depends on it, and on no scale of the function.
        least_gain: ends where ten iterations have lowered the value by at most this share of the whole decrease.

    Source: Lewis and Overton (2013), "Nonsmooth optimization via quasi-Newton methods".
    """
    value, slope_there = function(start)
    slope = slope_there()
    x, one = start, torch.eye(len(start), dtype=start.dtype, device=start.device)
    inverse = one * (radius / (float(slope.norm()) or 1.0))
    values = [value]
    for iteration in range(iterations):
        direction = -inverse @ slope
        down = float(slope @ direction)
        if not down < 0.0:
            break
        low, high, length = 0.0, float("inf"), 1.0
        for _ in range(_BISECTIONS):
            new = x + length * direction
            (now, slope_there), turned = function(new), None
            if not now <= value + _DECREASE * length * down:
                high = length
            elif float((turned := slope_there()) @ direction) < _SLOPE * down:
                low = length
            else:
                break
            length = 2.0 * low if high == float("inf") else 0.5 * (low + high)
        if not now < value:
            break
        turned = slope_there() if turned is None else turned
        step, change = new - x, turned - slope
        x, value, slope = new, now, turned
        values.append(value)
        if len(values) > _LATEST and values[-1 - _LATEST] - value <= least_gain * (values[0] - value):
            break
        curvature = float(step @ change)
        if curvature <= 0.0:
            continue
        if iteration == 0:
            inverse = one * (curvature / float(change @ change))
        left = one - torch.outer(step, change) / curvature
        inverse = left @ inverse @ left.mT + torch.outer(step, step) / curvature
    return x


def bounded_kinked_minimum(
    function: Valued,
    start: Tensor,
    lower: Tensor,
    upper: Tensor,
    radius: float,
    tries: int,
    least_gain: float,
) -> Tensor:
    """Return the lowest point [n] of a box that BFGS finds from a start, and from points beside the lowest one.

    Where kinks meet, and sides of the box are kinks, too, a slope may point to no decrease although there is one. So
    there are several tries.

    Args:
        function: as of `kinked_minimum`, within the box.
        start: [n], within the box.
        lower: finite [n], below `upper`.
        upper: finite [n].
        radius: as of `kinked_minimum`.
        tries: how often BFGS begins.
        least_gain: decrease, over the value at the lowest point, of a try after which no other one follows.
    """

    def folded(x: Tensor) -> tuple[float, Callable[[], Tensor]]:
        inside, signs = mirrored(x, lower, upper)
        value, slope = function(inside)
        return value, lambda: signs * slope()

    generator, best = torch.Generator(device="cpu").manual_seed(0), start
    lowest = function(start)[0]
    for number in range(tries):
        direction = torch.randn(len(start), generator=generator, dtype=start.dtype, device="cpu").to(start.device)
        beside = mirrored(best + _BESIDE * radius / float(direction.norm()) * direction, lower, upper)[0]
        end = kinked_minimum(folded, beside if number else best, _ITERATIONS, radius, _LEAST_GAIN)
        end = mirrored(end, lower, upper)[0]
        before, now = lowest, function(end)[0]
        if now < lowest:
            best, lowest = end, now
        if number and before - lowest <= least_gain * abs(lowest):
            break
    return best


def mirrored(x: Tensor, lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
    """Return the point of a box [n] that x leads to by reflections at its sides, and the signs [n] of the derivative.

    A function of the point it leads to has the kinks of a penalty at the sides, and no point outside is ever used.

    Args:
        x: [n].
        lower: finite [n], below `upper`.
        upper: finite [n].
    """
    if bool((x == x.clamp(lower, upper)).all()):
        return x, torch.ones_like(x)
    width = upper - lower
    along = (x - lower).remainder(2.0 * width)
    back = along > width
    at = lower + torch.where(back, 2.0 * width - along, along)
    return torch.where(x == x.clamp(lower, upper), x, at), torch.where(back, -1.0, 1.0).to(x)
