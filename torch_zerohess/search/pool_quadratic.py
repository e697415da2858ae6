"""A quadratic model around a point, from the evaluations near it."""

from collections.abc import Callable

import torch
from torch import Tensor

from torch_zerohess.search.state import Best
from torch_zerohess.surrogates.determined import with_true_errors
from torch_zerohess.surrogates.pool import Pool
from torch_zerohess.surrogates.quadratic import LocalModel, fit_outputs, fit_values

_NEAR, _WIDENING, _WIDEST = 1e-3, 1.5, 10.0
"""Weight from which an evaluation counts as near the best point; sigma is widened by the factor up to the last one."""


def quadratic_of_pool(
    best: Best, pool: Pool, loss: Callable[[Tensor], Tensor] | None, shape: torch.Size, least: int
) -> tuple[LocalModel, float] | None:
    """Return a quadratic model around a point and its sigma, or None if too few evaluations are near.

    Args:
        best: the point, and the sigma to begin with.
        pool: evaluations.
        loss: from an output to a scalar; None if there are no outputs.
        shape: of an output.
        least: evaluations that a model needs.
    """
    sigma = best.sigma
    while len(pool) and sigma < _WIDEST:
        weights = torch.exp(-0.5 * ((pool.points - best.point) / sigma).square().sum(1))
        near = weights > _NEAR
        if int(near.sum()) >= least:
            u = (pool.points[near] - best.point) / sigma
            if loss is None or pool.outputs is None:
                model = fit_values(u, pool.values[near], weights[near])
            else:
                model = fit_outputs(u, pool.outputs[near], weights[near], loss, shape)
            return with_true_errors(model, u, weights[near]), sigma
        sigma *= _WIDENING
    return None
