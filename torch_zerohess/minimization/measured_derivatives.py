"""Derivatives from evaluations on all sides of the point where a search has ended.

A Gaussian process of outputs evaluates where it expects the minimum, and seldom on all sides of it. The nearest
evaluations may lie nearly on a line. So a search that has found the minimum evaluates two further points along each
parameter.
"""

import torch
from torch import Tensor

from torch_zerohess.minimization.running import Running
from torch_zerohess.search.protocol.white_box import checked_loss
from torch_zerohess.search.trust_region import TrustRegion
from torch_zerohess.surrogates.quadratic import LocalModel, fit_outputs

_STEP = 0.05
"""Distance of the points from x, in units of sigma, which is at most the width of the bounds."""
_MOST = 8
"""Parameters up to which they are evaluated."""
_CENTER = 1e6
"""Weight of x among them: the output there is the intercept."""


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

    It is also None if an output around x is not finite.
    """
    points, loss = _surroundings(running.search, x), checked_loss(running.search.loss)
    if points is None or loss is None:
        return None
    count, told = len(points), running.record.told[0]
    outputs = running.record.outputs(len(told))[1][-count:]
    if len(outputs) < count or not torch.equal(told[-count:], points) or not bool(torch.isfinite(outputs).all()):
        return None
    step = _STEP * running.search.unit
    weights = torch.tensor([_CENTER] + (count - 1) * [1.0], dtype=step.dtype, device=step.device)
    u = (points - x).to(step) / step
    return fit_outputs(u, outputs.reshape(count, -1).to(step), weights, loss, outputs.shape[1:]), _STEP


def _surroundings(search: TrustRegion, x: Tensor) -> Tensor | None:
    """Return x [n] and two points beside it along each parameter, within the bounds: [2 n + 1, n].

    None for another search than a Gaussian process of outputs, or one of more than 8 parameters.
    """
    if search.loss is None or search.engine != "gaussian_process" or len(x) > _MOST:
        return None
    step = torch.diag(_STEP * search.unit)
    beside = x.to(step) + torch.cat([torch.zeros_like(step[:1]), step, -step])
    return beside.clamp(*search.bounds).to(x)
