"""Which derivatives evaluations determine.

Evaluations on a bound, for instance, do not show how the function changes across it: a fit with a prior returns zero.
"""

from dataclasses import replace

import torch
from torch import Tensor

from torch_zerohess.surrogates.quadratic import LocalModel, coefficient_count, quadratic_terms

_EXTENT = 1e-2
"""Least singular value of the weighted terms, in units of sigma: smaller ones are dominated by the
prior."""
_SHARE = 1e-6
"""Least part of a derivative in a direction that is not determined with which its error is infinite."""


def with_true_errors(model: LocalModel, u: Tensor, weights: Tensor) -> LocalModel:
    """Return a model that was fitted at u [P, n] with infinite errors of all derivatives that u does not determine."""
    P, n = u.shape
    if model.basis is not None:  # they are infinite
        return model
    squares = model.jacobian is None and coefficient_count(n) <= P
    unknown = _unknown(quadratic_terms(u) if squares else _linear_terms(u), weights)
    slopes = bends = unknown[1 : n + 1]
    if squares:
        row, column = torch.triu_indices(n, n, device=u.device)
        bends = unknown[n + 1 :][row == column]
    return replace(
        model,
        gradient_error=model.gradient_error.masked_fill(slopes, torch.inf),
        curvature_error=model.curvature_error.masked_fill(bends, torch.inf),
    )


def _linear_terms(u: Tensor) -> Tensor:
    return torch.cat([torch.ones_like(u[:, :1]), u], 1)


def _unknown(terms: Tensor, weights: Tensor) -> Tensor:
    """Return which coefficients [q] of terms [P, q] have a part in a direction without extent."""
    weighted = weights.sqrt()[:, None] * terms
    values, vectors = torch.linalg.eigh(weighted.mT @ weighted)
    return vectors[:, values < _EXTENT**2].norm(dim=1) > _SHARE
