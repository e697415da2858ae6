"""The minimum of a noisy loss by a regression on all evaluations: a quadratic, plus a process for what is not one."""

import math

import torch
from torch import Tensor

from torch_zerohess.linalg.subproblem import box_step
from torch_zerohess.minimization.record import Record
from torch_zerohess.search.trust_region import TrustRegion
from torch_zerohess.surrogates.noisy_derivatives import noisy_changes, noisy_derivatives
from torch_zerohess.surrogates.noisy_outputs import OutputRegression
from torch_zerohess.surrogates.quadratic import LocalModel

FITTED = 40
"""Parameters up to which a quadratic is fitted to all evaluations at the end."""
_STEPS = 5
"""Newton steps from the best point to the minimum, at most."""
_SHORT = 0.1
"""Length of a step, in units of the width of the evaluations, up to which it is the last one."""


class LossRegression:
    """A regression of losses with noise. See `noisy_derivatives` for the arguments, and `OutputRegression`."""

    def __init__(self, points: Tensor, losses: Tensor, noise: float) -> None:
        self._told = points, losses, noise

    def derivatives(self, x: Tensor) -> tuple[LocalModel, Tensor] | None:
        return noisy_derivatives(x, *self._told)

    def change(self, x: Tensor, other: Tensor) -> tuple[float, float] | None:
        found = noisy_changes(x, other[None], *self._told)
        return None if found is None else (float(found[0]), float(found[1]))


def regression(
    record: Record, search: TrustRegion, count: int, noise: float
) -> LossRegression | OutputRegression | None:
    """Return a regression of the first `count` evaluations: of their outputs, if most are kept, otherwise of losses.

    None with more parameters than a quadratic is fitted to, or where the search has a better one.

    Args:
        record: of the evaluations.
        search: whose points they are.
        count: number of evaluations.
        noise: standard deviation of repeated losses at one point.
    """
    points, losses = record.keeping(search.untouched, search.x)
    if points.shape[1] > FITTED:
        return None
    points, losses = points[:count].double(), losses[:count]
    if search.loss is None:
        return LossRegression(points, losses, noise)
    first, outputs = record.outputs(count)
    known = torch.isfinite(losses[first:])
    if 2 * int(known.sum()) < len(losses):
        return None if search.averages else LossRegression(points, losses, noise)
    outputs = outputs[known].to(losses)
    return OutputRegression(points[first:][known], outputs.flatten(1), search.loss, outputs.shape[1:])


def modelled_minimum(
    x: Tensor, regression: LossRegression | OutputRegression, bounds: tuple[Tensor, Tensor]
) -> Tensor | None:
    """Return the minimum [n] of a regression near x; x itself if the regression is not sure of a lower loss there.

    None if the evaluations do not determine a quadratic. The width of the evaluations that determine it bounds each
    Newton step. The decrease from x must be more than its standard error: beside a kink the regression takes losses for
    equal that are not.

    Args:
        x: where to begin [n].
        regression: of the evaluations.
        bounds: lower and upper [n].
    """
    at = start = x.double()
    lower, upper = (one.double() for one in bounds)
    radius = math.sqrt(len(x))
    for _ in range(_STEPS):
        found = regression.derivatives(at)
        if found is None:
            return None
        model, width = found
        step = box_step(model.gradient, model.hessian, radius, (lower - at) / width, (upper - at) / width)
        at = (at + width * step).clamp(lower, upper)
        if float(step.norm()) < _SHORT * radius:
            break
    change = regression.change(at, start)
    return at.to(x) if change is not None and change[0] > change[1] else x
