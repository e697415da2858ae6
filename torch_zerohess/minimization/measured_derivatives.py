"""Derivatives from evaluations on all sides of the point where a search has ended.

A Gaussian process of outputs evaluates where it expects the minimum, and seldom on all sides of it. The nearest
evaluations may lie nearly on a line. So a search that has found the minimum evaluates three further points along each
parameter. The slope of each output is the slope of the cubic through them and x. Its error is the distance from the
slope of the parabola through the first two of them and x: the third one shows what a parabola misses.
"""

import math

import torch
from torch import Tensor

from torch_zerohess.minimization.running import Running
from torch_zerohess.search.protocol.white_box import WhiteBox, checked_loss
from torch_zerohess.search.trust_region import TrustRegion
from torch_zerohess.surrogates.loss_curvature import loss_curvature
from torch_zerohess.surrogates.quadratic import LocalModel

_STEP = 0.05
"""Distance of the points from x, in units of sigma, which is at most the width of the bounds."""
_MOST = 8
"""Parameters up to which they are evaluated."""
_AROUND, _WITHIN = (1.0, -1.0, 0.5), (1.0, 0.5, 1.5)
"""Places of the points along a parameter, in units of the distance: around x, or away from a bound that is nearer."""
_APART = 1e-3
"""Least distance between two points along a parameter, in the same units. In float32 they can fall together."""


def measure(running: Running) -> None:
    """Evaluate x and the points around it; once more around a lower one among them.

    Not if it is done, if too few evaluations are left, or if there are no outputs.
    """
    for _ in range(2):
        x = running.best.x
        points = _surroundings(running.search, x)
        if points is None or len(points) > running.left or measured(running, x) is not None:
            return
        running.record.keeps_outputs = True
        running.evaluate(points)


def measured(running: Running, x: Tensor) -> tuple[LocalModel, float] | None:
    """Return a quadratic around x [n] and its width in units of sigma; None if `measure` has not seen x last.

    It is also None if an output around x is not finite, or if points fall together.
    """
    points, loss = _surroundings(running.search, x), checked_loss(running.search.loss)
    if points is None or loss is None:
        return None
    count, told = len(points), running.record.told[0]
    outputs = running.record.outputs(len(told))[1][-count:]
    if len(outputs) < count or not torch.equal(told[-count:], points) or not bool(torch.isfinite(outputs).all()):
        return None
    step = _STEP * running.search.unit
    # A point differs from x in one parameter: [n, 3] of its distances.
    u = ((points[1:].to(step) - x.to(step)) / step).view(len(_AROUND), len(x), len(x)).diagonal(dim1=1, dim2=2).mT
    if float(torch.cat([torch.zeros_like(u[:, :1]), u], 1).sort(1).values.diff(dim=1).min()) < _APART:
        return None
    changes = (outputs[1:] - outputs[:1]).reshape(len(_AROUND), len(x), -1).to(step)
    return _model(u, outputs[0].to(step), changes.transpose(0, 1), loss), _STEP


def _model(u: Tensor, output: Tensor, changes: Tensor, loss: WhiteBox) -> LocalModel:
    """Return the quadratic model of a loss whose output [*out] changes by [n, 3, m] at distances u [n, 3]."""
    powers = torch.stack([u, u.square(), u**3], 2)
    jacobian = torch.linalg.solve(powers, changes)[:, 0]
    missed = jacobian - torch.linalg.solve(powers[:, :2, :2], changes[:, :2])[:, 0]
    expanded = loss_curvature(loss, output)
    slope, bend = expanded.slope.flatten(), expanded.products(jacobian.view(len(u), *output.shape))
    hessian = jacobian @ bend.mT

    def error(directions: Tensor) -> Tensor:
        """Standard errors [n] of J times directions [*, m]: errors of outputs add up, or are independent."""
        together, single = (missed * directions).sum(1).abs(), (missed * directions).norm(dim=1)
        return torch.maximum(together, single).clamp_min(math.ulp(0.0))

    hessian = 0.5 * (hessian + hessian.mT)
    return LocalModel(expanded.value, jacobian @ slope, hessian, None, error(slope[None]), 2.0 * error(bend))


def _surroundings(search: TrustRegion, x: Tensor) -> Tensor | None:
    """Return x [n] and three points beside it along each parameter, within the bounds: [3 n + 1, n].

    None for another search than a Gaussian process of outputs, or one of more than 8 parameters.
    """
    if search.loss is None or search.engine != "gaussian_process" or len(x) > _MOST:
        return None
    step, (lower, upper) = _STEP * search.unit, search.bounds
    around, within = (torch.tensor(one, dtype=step.dtype, device=step.device)[:, None] for one in (_AROUND, _WITHIN))
    below, above = x.to(step) - lower < step, upper - x.to(step) < step
    u = torch.where(above, -within, torch.where(below, within, around))
    beside = x.to(step) + torch.cat([torch.zeros_like(step[None]), torch.diag_embed(u * step).flatten(0, 1)])
    return beside.clamp(lower, upper).to(x)
