"""A quadratic model around a point, from the evaluations near it."""

from collections.abc import Callable

import torch
from torch import Tensor

from torch_zerohess.search.protocol.state import Best
from torch_zerohess.surrogates.determined import with_true_errors
from torch_zerohess.surrogates.pool import Pool
from torch_zerohess.surrogates.quadratic import LocalModel, fit_outputs, fit_values

_Loss = Callable[[Tensor], Tensor] | None
"""From an output to a scalar; None where the loss alone is modelled."""

NEAR, _WIDENING = 1e-3, 1.5
"""Weight from which an evaluation counts as near the best point; factor by which sigma is widened."""


def quadratic_of_pool(
    best: Best,
    pool: Pool,
    loss: _Loss,
    shape: torch.Size,
    least: int,
    widest: float,
    weights: Callable[[Tensor, float], Tensor],
) -> tuple[LocalModel, float] | None:
    """Return a quadratic model around a point and its sigma, or None if too few evaluations are near.

    Args:
        best: the point, and the sigma to begin with.
        pool: evaluations.
        loss: of an output.
        shape: of an output.
        least: evaluations that a model needs.
        widest: sigma is below this.
        weights: of the evaluations [P] around a point [n], for a sigma.
    """
    sigma = best.sigma
    while len(pool) and sigma < widest:
        w = weights(best.point, sigma)
        near = w > NEAR
        if int(near.sum()) >= least:
            u = (pool.points[near] - best.point) / sigma
            return with_true_errors(fit_pool(u, pool, near, w[near], loss, shape), u, w[near]), sigma
        sigma *= _WIDENING
    return None


def fit_pool(
    u: Tensor, pool: Pool, which: Tensor, weights: Tensor, loss: _Loss, shape: torch.Size, damping: float = 0.0
) -> LocalModel:
    """Fit to evaluations of a pool, bools [P], at u [p, n] with weights [p]: to outputs, if any, under a loss."""
    if loss is None or pool.outputs is None:
        return fit_values(u, pool.values[which], weights)
    return fit_outputs(u, pool.outputs[which], weights, loss, shape, damping)
