"""Steps of several lengths by a sparse Jacobian J: to the minimum of a quadratic, or of the loss of linear outputs.

The quadratic is g J s + s J^T H J s / 2, with gradient g and Hessian H of the loss after the output. It is wrong at a
kink of the loss, and where the curvature of the loss changes along a step: the loss of the output + J s says so,
without an evaluation of the black box. There this loss itself is minimised (`smoothed_minimum`), within the longest
step. It is convex if the loss is, so the shorter steps lead along the same line.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torch_zerohess.linalg.bounded_krylov import bounded_krylov_step
from torch_zerohess.linalg.krylov import are_free, krylov_steps
from torch_zerohess.linalg.nonsmooth import bounded_kinked_minimum
from torch_zerohess.linalg.smoothed_newton import LinearOutputs, smoothed_minimum
from torch_zerohess.surrogates.loss_curvature import LossCurvature, loss_curvature, value_and_slope
from torch_zerohess.surrogates.sparse_jacobian import SparseJacobian

_ITERATIONS = 100
"""Products of the Hessian for a step."""
_EXPANDED, _ROUNDED = 0.5, 1e-12
"""Error of the quadratic's promise, over the promise and over the loss, with which its steps are taken."""

_CLOSE = 0.01
"""The same for the step of a thorough search."""
_TRIES, _NOTHING = 4, 1e-8
"""Minimisations of a thorough search, at most, and the decrease of one, over the loss, after which it ends."""
THOROUGH = 200
"""Parameters up to which it minimises a loss with kinks as it is: it keeps a square matrix of them."""

LITTLE = 1e-5
"""Decrease that the loss of linear outputs promises, over the loss, with which a search has arrived."""

Loss = Callable[[Tensor], Tensor]


@dataclass(frozen=True, eq=False)
class SparseSteps:
    """Steps [k, n], and how far the longest one lowers the loss of linear outputs.

    None where a quadratic holds that is curved along this step.
    """

    steps: Tensor
    promised: float | None = None


def derivatives(expanded: LossCurvature, jacobian: SparseJacobian) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
    """Return the gradient [n] of a loss that is expanded at the output, and the product with its Hessian J^T H J."""
    gradient = jacobian.rmatvec(expanded.slope)
    return gradient, lambda v: jacobian.rmatvec(expanded.product(jacobian.matvec(v)))


def sparse_steps(
    loss: Loss, output: Tensor, jacobian: SparseJacobian, radii: Tensor, lower: Tensor, upper: Tensor
) -> SparseSteps:
    """Return a step within each of the radii [k], the longest one last.

    Args:
        loss: of an output.
        output: at the center [*out], float64.
        jacobian: there.
        radii: in rising order.
        lower: bounds of steps [n], at most 0.
        upper: at least 0.
    """
    gradient, product = derivatives(loss_curvature(loss, output), jacobian)
    free = are_free(torch.zeros_like(gradient), gradient, lower, upper)
    steps = krylov_steps(lambda v: free * product(v), free * gradient, radii, iterations=_ITERATIONS)

    rows, columns = jacobian.entries
    outputs = linear_outputs(loss, output, lambda s: rows.times(s[None])[0], lambda w: columns.times(w[None])[0])
    bent = torch.stack([v @ product(v) for v in steps])
    widths = jacobian.values.to(radii).square().sum(1).sqrt() * (float(radii[-1]) / math.sqrt(jacobian.n))
    return checked_steps(outputs, steps, gradient, bent, widths, radii, lower, upper)


def thorough_step(
    loss: Loss, output: Tensor, jacobian: SparseJacobian, longest: float, lower: Tensor, upper: Tensor, start: Tensor
) -> SparseSteps:
    """Return one step [1, n] to the lowest point that a thorough search finds, which calls the loss 1000 times.

    The steps of `sparse_steps` end where bounds and kinks meet, although a longer way leads on: see
    `bounded_krylov_step` and `bounded_kinked_minimum`. Above `THOROUGH` parameters kinks are smoothed here, too.

    Args:
        loss: of an output.
        output: at the center [*out], float64.
        jacobian: there.
        longest: length of the step, at most.
        lower: bounds of steps [n], at most 0.
        upper: at least 0.
        start: [n], a step within the bounds.
    """
    gradient, product = derivatives(loss_curvature(loss, output), jacobian)
    rows, columns = jacobian.entries
    outputs = linear_outputs(loss, output, lambda s: rows.times(s[None])[0], lambda w: columns.times(w[None])[0])
    zero = torch.zeros_like(gradient)
    before = outputs.value(zero)
    s = bounded_krylov_step(product, gradient, longest, lower, upper, zero, iterations=_ITERATIONS)
    promised = -float(gradient @ s + 0.5 * (s @ product(s)))
    if abs(before - outputs.value(s) - promised) <= _CLOSE * promised + _ROUNDED * abs(before):
        return SparseSteps(s[None], promised)
    start = min(zero, start * min(1.0, longest / max(float(start.norm()), math.ulp(0.0))), s, key=outputs.value)
    if jacobian.n > THOROUGH:
        widths = jacobian.values.to(s).square().sum(1).sqrt() * (longest / math.sqrt(jacobian.n))
        end, promised = smoothed_minimum(outputs, widths, longest, lower, upper, start)
        return SparseSteps(end[None], promised)

    def function(s: Tensor) -> tuple[float, Tensor]:
        value, slope = outputs.loss(outputs.output + outputs.matvec(s))
        return value, outputs.rmatvec(slope)

    lower, upper = (one.clamp(-longest, longest) for one in (lower, upper))
    end = bounded_kinked_minimum(function, start, lower, upper, longest, _TRIES, _NOTHING)
    end = end * min(1.0, longest / max(float(end.norm()), math.ulp(0.0)))
    return SparseSteps(end[None], before - outputs.value(end))


def linear_outputs(
    loss: Loss, output: Tensor, matvec: Callable[[Tensor], Tensor], rmatvec: Callable[[Tensor], Tensor]
) -> LinearOutputs:
    """Return outputs that are linear in the parameters, with the loss of an output [*out]; see `LinearOutputs`."""

    def valued(y: Tensor) -> tuple[float, Tensor]:
        value, slope = value_and_slope(loss, y.view(output.shape))
        return value, slope.flatten()

    return LinearOutputs(valued, output.flatten(), matvec, rmatvec)


def checked_steps(
    outputs: LinearOutputs,
    steps: Tensor,
    gradient: Tensor,
    bent: Tensor,
    widths: Tensor,
    radii: Tensor,
    lower: Tensor,
    upper: Tensor,
) -> SparseSteps:
    """Return the steps [k, n] of a quadratic where it holds, and else steps to the minimum of linear outputs.

    Args:
        outputs: with their loss.
        steps: within the radii [k], which are in rising order.
        gradient: of the quadratic [n].
        bent: s.Hs of each step [k].
        widths: how far outputs change within the longest radius [m], about.
        radii: [k].
        lower: bounds of steps [n], at most 0.
        upper: at least 0.
    """
    before, down, longest = outputs.value(torch.zeros_like(gradient)), steps @ gradient, float(radii[-1])
    if all(_holds(outputs, before, s, float(one)) for s, one in zip(steps, -(down + 0.5 * bent), strict=True)):
        straight = float(bent[-1]) <= -_ROUNDED * float(down[-1])
        return SparseSteps(steps, -float(down[-1]) if straight else None)
    start = min(steps.clamp(lower, upper), key=outputs.value)
    end, promised = smoothed_minimum(outputs, widths, longest, lower, upper, start)
    return SparseSteps(radii[:, None] / longest * end, promised)


def _holds(outputs: LinearOutputs, before: float, s: Tensor, promised: float) -> bool:
    """Whether the quadratic promises at s [n] about what the loss of linear outputs does."""
    return not abs(before - outputs.value(s) - promised) > _EXPANDED * promised + _ROUNDED * abs(before)
