"""Quadratic of a loss by least change: interpolate the values near a point, and change the Hessian no more than needed.

A full quadratic in n parameters has (n + 1)(n + 2)/2 coefficients, more than a search has evaluations. Many quadratics
interpolate the values. We take the quadratic with the Hessian nearest to an earlier Hessian in the Frobenius norm. It
is unique once the points span the space (Powell 2004, "Least Frobenius norm updating of quadratic models").
"""

from dataclasses import dataclass

import torch
from torch import Tensor

_EXACT = 1e-10
"""Variance of a value that is no quadratic, in units of the mean variance of the quadratics at the points."""
_CUBIC = 1e-8
"""The same per sixth power of the distance: a smooth function leaves a quadratic by third powers."""
_FREE = 1e-12
"""Prior precision of value and slope, in units of the values' own precision."""
_CUBIC_OUTPUT = 1e-3
"""Like `_CUBIC`, for the quadratics of outputs: their slopes are trusted, and not their curvatures."""


def least_change(u: Tensor, values: Tensor, hessian: Tensor) -> tuple[float, Tensor, Tensor]:
    """Return value, gradient [n] and Hessian [n, n] at u = 0 of the quadratic of least change.

    Args:
        u: points [P, n], of the order of 1.
        values: [P], of the order of 1.
        hessian: the earlier one [n, n].

    With fewer than n + 1 points the gradient has the least norm. With more points than a quadratic has coefficients the
    result is a regression, in which near points count more than far ones.
    """
    P, n = u.shape
    rest = values - 0.5 * ((u @ hessian) * u).sum(1)
    factor = _factor(u, _CUBIC)
    linear = torch.cat([u.new_ones(P, 1), u, rest[:, None]], 1)
    white = torch.linalg.solve_triangular(factor, linear, upper=False)
    design, target = white[:, :-1], white[:, -1]
    scale = float(design.square().sum(0).amax())
    padded = torch.cat([design, (_FREE * scale) ** 0.5 * torch.eye(n + 1, dtype=u.dtype, device=u.device)])
    q, r = torch.linalg.qr(padded)
    slope = torch.linalg.solve_triangular(r, (q.mT @ torch.cat([target, target.new_zeros(n + 1)]))[:, None], upper=True)
    left = (target - design @ slope[:, 0])[:, None]
    alpha = torch.linalg.solve_triangular(factor.mT, left, upper=True)[:, 0]
    change = (u.mT * alpha) @ u
    return float(slope[0, 0]), slope[1:, 0], hessian + 0.5 * (change + change.mT)


@dataclass(frozen=True)
class LeastNorm:
    """Quadratics q with q(0) = 0, one per output, of least Hessian norm.

    With fewer than n points the Jacobian has the least norm. Far points count less. Costs O(P^3 + n P m): the Hessian
    of each output is not computed, only their sums.
    """

    u: Tensor
    """Points [P, n], of the order of 1."""
    changes: Tensor
    """Of the outputs from u = 0 to these points [P, m]."""
    factor: Tensor
    jacobian: Tensor
    """At u = 0 [n, m]."""

    @classmethod
    def through(cls, u: Tensor, changes: Tensor) -> "LeastNorm":
        """Return the quadratics through changes [P, m] at u [P, n]."""
        factor = _factor(u, _CUBIC_OUTPUT)
        white = torch.linalg.solve_triangular(factor, u, upper=False)
        gram = white.mT @ white
        gram.diagonal().add_(_FREE * (float(gram.diagonal().mean()) or 1.0))
        weights = torch.linalg.solve_triangular(factor.mT, white, upper=True)
        return cls(u, changes, factor, torch.cholesky_solve(weights.mT @ changes, torch.linalg.cholesky(gram)))

    def hessian(self, slope: Tensor) -> Tensor:
        """Return the sum of the Hessians [n, n], weighted by the slope [m]."""
        left = self.changes @ slope - self.u @ (self.jacobian @ slope)
        alpha = torch.cholesky_solve(left[:, None], self.factor)
        return (self.u * alpha).mT @ self.u


def _factor(u: Tensor, cubic: float) -> Tensor:
    """Return the Cholesky factor of the covariance of values at u [P, n] whose slopes and constant are subtracted."""
    inner = u @ u.mT
    kernel = 0.5 * inner.square()
    unit = float(kernel.diagonal().mean()) or 1.0
    kernel.diagonal().add_(_EXACT * unit + cubic * inner.diagonal().pow(3))
    return torch.linalg.cholesky(kernel)
