"""Which derivatives evaluations determine, and the nearest ones that determine all slopes.

Evaluations on a bound, for instance, do not tell how the function changes across it: a fit with a prior returns zero.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from torch_zerohess.surrogates.quadratic import LocalModel, coefficients, quadratic_terms

NEAR, WIDENING = 1e-3, 1.5
"""Weight from which an evaluation counts as near, and the factor by which a neighbourhood is widened."""
_WIDEST = 10.0
"""Sigma up to which it is widened."""
_EXTENT = 1e-2
"""Least singular value of what a coefficient is multiplied with, in units of sigma: less is lost in the prior."""
_SHARE = 1e-6
"""Least part of a derivative in a direction that is not determined with which its error is infinite."""


class Neighbourhood(NamedTuple):
    """Evaluations around a point: which they are [K], their places u = (z - x)/sigma [P, n], weights [P], and sigma."""

    near: Tensor
    u: Tensor
    weights: Tensor
    sigma: float


def nearest_told(
    points: Tensor, x: Tensor, sigma: float, least: int, weigh: Callable[[float], Tensor], patience: float = _WIDEST
) -> Neighbourhood | None:
    """Return the narrowest neighbourhood whose evaluations determine all slopes, or else the first with enough of them.

    Args:
        points: evaluations [P, n].
        x: the centre [n].
        sigma: the first width.
        least: more evaluations than this are enough.
        weigh: returns the weights [P] of the evaluations for a sigma.
        patience: sigma from which it returns None if none had enough.
    """
    first, n = None, len(x)
    while len(points) and sigma < (patience if first is None else _WIDEST):
        weights = weigh(sigma)
        near = weights > NEAR
        P = int(near.sum())
        if least < P:
            found = Neighbourhood(near, (points[near] - x) / sigma, weights[near], sigma)
            # To widen it for one evaluation more than slopes is no use: it tells no errors.
            if (n if first is None else n + 1) < P and not bool(_unknown(_linear_terms(found.u), found.weights).any()):
                return found
            first = first or found
            if n >= P:
                return first
        sigma *= WIDENING
    return first


def with_true_errors(model: LocalModel, u: Tensor, weights: Tensor) -> LocalModel:
    """Return a model that was fitted at u [P, n] with infinite errors of all derivatives that u does not determine."""
    P, n = u.shape
    if model.basis is not None:  # they are infinite
        return model
    squares = model.jacobian is None and coefficients(n) <= P
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
