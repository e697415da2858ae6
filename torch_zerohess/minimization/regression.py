"""The minimum of a noisy loss by a regression on all evaluations: a quadratic, plus a process for what is not one."""

import math

from torch import Tensor

from torch_zerohess.linalg.subproblem import box_step
from torch_zerohess.surrogates.noisy_derivatives import noisy_changes, noisy_derivatives

FITTED = 40
"""Parameters up to which a quadratic is fitted to all evaluations at the end."""
_STEPS = 5
"""Newton steps from the best point to the minimum, at most."""
_SHORT = 0.1
"""Length of a step, in units of the width of the evaluations, up to which it is the last one."""


def modelled_minimum(
    x: Tensor, points: Tensor, losses: Tensor, noise: float, bounds: tuple[Tensor, Tensor]
) -> Tensor | None:
    """Return the minimum [n] of the regression near x; x itself if the regression is not sure of a lower loss there.

    None if the evaluations do not determine a quadratic. Each Newton step is at most as long as the evaluations that
    tell the quadratic are wide. The decrease from x must be more than its standard error: beside a kink the regression
    takes losses for equal that are not.

    Args:
        x: where to begin [n].
        points: evaluations [P, n].
        losses: [P], float64; those that are not finite are left out.
        noise: standard deviation of repeated losses at one point.
        bounds: lower and upper [n].
    """
    if len(x) > FITTED:
        return None
    at = start = x.double()
    told = points.double(), losses, noise
    lower, upper = (one.double() for one in bounds)
    radius = math.sqrt(len(x))
    for _ in range(_STEPS):
        found = noisy_derivatives(at, *told)
        if found is None:
            return None
        model, width = found
        step = box_step(model.gradient, model.hessian, radius, (lower - at) / width, (upper - at) / width)
        at = (at + width * step).clamp(lower, upper)
        if float(step.norm()) < _SHORT * radius:
            break
    change = noisy_changes(at, start[None], *told)
    return at.to(x) if change is not None and bool(change[0] > change[1]) else x
