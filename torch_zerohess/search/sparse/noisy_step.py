"""The output at the center by a sparse Jacobian in noise, and a step that minimises the expected loss.

The expected loss has the variance of the predicted outputs in it: the sum of squares of (error of a slope times step).
So the step is short along directions that noise hides. At a kink of the loss the step is that of `sparse_steps`.
"""

import math

import torch
from torch import Tensor

from torch_zerohess.linalg.krylov import are_free, krylov_steps
from torch_zerohess.search.protocol.method import Settings
from torch_zerohess.search.sparse.progress import SparseProgress
from torch_zerohess.search.sparse.steps import derivatives, sparse_steps
from torch_zerohess.surrogates.loss_curvature import LossCurvature, alternating, loss_curvature
from torch_zerohess.surrogates.sparse_jacobian import SparseJacobian

_CURVED = 3.0
"""Standard errors of a sum of squares by which it must exceed noise to be curvature."""
_ITERATIONS = 100
"""Products of the Hessian for a step."""


def step_in_noise(known: SparseProgress, settings: Settings) -> Tensor:
    """Return the step from the center to the minimum of the model within the radius [n]."""
    jacobian, x, loss = known.jacobian, known.center, settings.white_box
    assert jacobian is not None
    output, radii = known.shaped_output, x.new_tensor([known.radius * math.sqrt(settings.n)])
    lower, upper = settings.lower - x, settings.upper - x
    kinked = sparse_steps(loss, output, jacobian, radii, lower, upper)
    if kinked.promised is not None:
        return kinked.steps[0]
    expanded = loss_curvature(loss, output)
    gradient, product = derivatives(expanded, jacobian)
    free = are_free(torch.zeros_like(x), gradient, lower, upper)
    own = uncertain(expanded, jacobian, output)

    def bent(v: Tensor) -> Tensor:
        return free * (product(free * v) + own * v)

    return krylov_steps(bent, free * gradient, radii, iterations=_ITERATIONS)[0]


def uncertain(expanded: LossCurvature, jacobian: SparseJacobian, output: Tensor) -> Tensor:
    """Return the curvatures of the expected loss [n] by the errors of slopes.

    They take the diagonal of the Hessian of the loss: products with signs give it up to the other elements.
    """
    signs = alternating(output)
    bent = (expanded.product(signs) * signs).flatten().clamp_min(0.0)
    squares = bent[:, None] * (jacobian.standard_error * jacobian.found).double().square()
    return output.new_zeros(jacobian.n).index_add_(0, jacobian.index.flatten(), squares.flatten())


def constants(predicted: Tensor, left: Tensor, entries: int) -> tuple[Tensor, float, float]:
    """Return the constants [m] that the slopes leave, the variance of the rest, and as how many values they are exact.

    The constants are means of what the slopes leave of the changes. Curvature would move them. So where all outputs
    together show curvature, it is fitted, too: as a multiple of the squared prediction.

    Args:
        predicted: changes [K, m] by the slopes.
        left: what the slopes leave of the changes [K, m].
        entries: how many slopes there are.
    """
    (K, m), left = left.shape, left.double()
    mean, square = left.mean(0), predicted.square()
    least = torch.finfo(square.dtype).tiny
    middle, rest = square.mean(0), left - mean
    square = square - middle
    length = square.square().sum(0).clamp_min(least)
    bend = (square * rest).sum(0) / length
    curved, total = float((bend.square() * length).sum()), float(rest.square().sum())
    free = max(K - 1 - entries / m, 2.0)
    variance = (total - curved) / ((free - 1.0) * m)
    if curved <= (m + _CURVED * math.sqrt(2.0 * m)) * variance:
        return mean, total / (free * m), float(K)
    return mean - bend * middle, variance, K / (1.0 + K * float((middle.square() / length).mean()))
