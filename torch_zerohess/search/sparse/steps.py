"""Steps of several lengths by a sparse Jacobian J: to the minimum of a quadratic, or of the loss of linear outputs.

The quadratic is g J s + s J^T H J s / 2, with gradient g and Hessian H of the loss after the output. The linear outputs
are output + J s, see `kinked_steps`.
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from torch_zerohess.linalg.bounded_krylov import bounded_krylov_step
from torch_zerohess.linalg.krylov import are_free, krylov_steps
from torch_zerohess.linalg.nonsmooth import bounded_kinked_minimum
from torch_zerohess.linalg.smoothed_newton import LinearOutputs, smoothed_minimum
from torch_zerohess.search.gauss_newton.kinked_steps import (
    NOTHING,
    Loss,
    Steps,
    checked_steps,
    holds,
    linear_outputs,
    shortened,
)
from torch_zerohess.surrogates.loss_curvature import LossCurvature, loss_curvature, value_then_slope
from torch_zerohess.surrogates.sparse_jacobian import SparseJacobian

_ITERATIONS = 100
"""Products of the Hessian for a step."""
_CLOSE = 0.01
"""Error of the quadratic's promise, over the promise, with which the step of a thorough search is taken."""
_TRIES = 4
"""Minimisations of a thorough search, at most."""
THOROUGH = 200
"""Parameters up to which it minimises a loss with kinks as it is: it keeps a square matrix of them."""


def derivatives(expanded: LossCurvature, jacobian: SparseJacobian) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
    """Return the gradient [n] of a loss that is expanded at the output, and the product with its Hessian J^T H J."""
    gradient = jacobian.rmatvec(expanded.slope)
    return gradient, lambda v: jacobian.rmatvec(expanded.product(jacobian.matvec(v)))


def sparse_steps(
    loss: Loss, output: Tensor, jacobian: SparseJacobian, radii: Tensor, lower: Tensor, upper: Tensor
) -> Steps:
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
    outputs = _linear(loss, output, jacobian)
    bent = torch.stack([v @ product(v) for v in steps])
    return checked_steps(outputs, steps, gradient, bent, _widths(jacobian, radii[-1]), radii, lower, upper)


def thorough_step(
    loss: Loss, output: Tensor, jacobian: SparseJacobian, longest: float, lower: Tensor, upper: Tensor, start: Tensor
) -> Steps:
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
    outputs = _linear(loss, output, jacobian)
    zero = torch.zeros_like(gradient)
    before = outputs.value(zero)
    s = bounded_krylov_step(product, gradient, longest, lower, upper, zero, iterations=_ITERATIONS)
    promised = -float(gradient @ s + 0.5 * (s @ product(s)))
    if holds(before, outputs.value(s), promised, _CLOSE):
        return Steps(s[None], promised)
    start = min(zero, shortened(start, longest), s, key=outputs.value)
    if jacobian.n > THOROUGH:
        widths = _widths(jacobian, s.new_tensor(longest))
        end, promised = smoothed_minimum(outputs, widths, longest, lower, upper, start)
        return Steps(end[None], promised)

    def function(s: Tensor) -> tuple[float, Callable[[], Tensor]]:
        value, slope = value_then_slope(loss, (outputs.output + outputs.matvec(s)).view(output.shape))
        return value, lambda: outputs.rmatvec(slope().flatten())

    lower, upper = (one.clamp(-longest, longest) for one in (lower, upper))
    end = shortened(bounded_kinked_minimum(function, start, lower, upper, longest, _TRIES, NOTHING), longest)
    return Steps(end[None], before - outputs.value(end))


def _linear(loss: Loss, output: Tensor, jacobian: SparseJacobian) -> LinearOutputs:
    """Return output + J s."""
    rows, columns = jacobian.entries
    return linear_outputs(loss, output, lambda s: rows.times(s[None])[0], lambda w: columns.times(w[None])[0])


def _widths(jacobian: SparseJacobian, longest: Tensor) -> Tensor:
    """Return how far outputs change [m] by a step of this length, about."""
    return jacobian.values.to(longest).square().sum(1).sqrt() * (float(longest) / math.sqrt(jacobian.n))
