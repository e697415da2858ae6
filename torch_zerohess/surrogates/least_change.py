"""Quadratic of a loss by least change: interpolate the values near a point, and change the Hessian no more than needed.

A full quadratic in n parameters has (n + 1)(n + 2)/2 coefficients, more than a search has evaluations. Many quadratics
interpolate the values. Powell's method takes the quadratic whose Hessian is nearest to an earlier Hessian in the
Frobenius norm. It is unique once the points span the space (Powell 2004, "Least Frobenius norm updating of quadratic
models"). It is the mean of a Gaussian process: the entries of the change of the Hessian are independent normal numbers.

The process here differs in two ways. On the way to a minimum all curvatures often grow or fall together. So the change
also has a multiple of the identity, with a normal factor. With more than four parameters it also has a multiple of the
earlier Hessian, as in self-scaling quasi-Newton methods (Oren and Luenberger 1974). And a value at u differs from the
quadratic by a normal number whose variance grows as |u|^6. How fast it grows depends on the function. Many values
choose between two rates by their likelihoods (Rasmussen and Williams 2006, section 5.4). Few values get the faster
rate: quadratics through far points fit them nearly always, and the slopes of these quadratics are wrong.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torch_zerohess.surrogates.quadratic import coefficient_count

_EXACT = 1e-10
"""Variance of a value that is no quadratic, in units of the mean variance of the quadratics at the points."""
_CUBIC, _ROUGH = 1e-8, 1e-3
"""The same per sixth power of the distance: of a function that is nearly quadratic, and of another one. A smooth
function leaves a quadratic by third powers."""
_FEW, _OF_FEW = 0.6, 1e-2
"""Fewer values than this, over the coefficients of a quadratic, get the rate that follows: their likelihood would
nearly always choose `_CUBIC`."""
_ALIKE = 1.0
"""Variance of the multiple of the identity, over the variance of an entry beside the diagonal."""
_SCALED = 10.0
"""Like `_ALIKE`, for the multiple of the earlier Hessian, divided by its Frobenius norm and times that of I."""
_TOLD = 4
"""Parameters up to which the values soon tell all curvatures, so that no multiple of the earlier Hessian is needed."""
_LIKELIER = 20.0
"""`_ROUGH` is taken where it makes the values more than so many times as likely as `_CUBIC` does."""
_FREE = 1e-12
"""Prior precision of value and slope, in units of the values' own precision."""
_CUBIC_OUTPUT = 1e-3
"""Like `_ROUGH`, for the quadratics of outputs: their slopes are trusted, and not their curvatures."""


def least_change(u: Tensor, values: Tensor, hessian: Tensor) -> tuple[float, Tensor, Tensor]:
    """Return value, gradient [n] and Hessian [n, n] at u = 0 of the quadratic of least change.

    Args:
        u: points [P, n], of the order of 1.
        values: [P], of the order of 1.
        hessian: the earlier one [n, n].

    With fewer than n + 1 points the gradient has the least norm. With more points than a quadratic has coefficients the
    result is a regression. Near points count more than far ones, and much more where the points are few or where the
    likelihood of the values says so.
    """
    n = u.shape[1]
    curved = ((u @ hessian) * u).sum(1)
    rest = values - 0.5 * curved
    scale = (_SCALED * n) ** 0.5 / (float(hessian.norm()) or 1.0) if n > _TOLD else 0.0
    bend = scale * curved
    if len(u) < _FEW * coefficient_count(n):
        fit = _Affine.through(u, values, rest, bend, _OF_FEW)
    else:
        smooth, rough = (_Affine.through(u, values, rest, bend, rate) for rate in (_CUBIC, _ROUGH))
        fit = rough if rough.likelihood > smooth.likelihood + math.log(_LIKELIER) else smooth
    alpha = torch.linalg.solve_triangular(fit.factor.mT, fit.left[:, None], upper=True)[:, 0]
    change = (u.mT * alpha) @ u + 0.5 * float(alpha @ bend) * scale * hessian
    change.diagonal().add_(0.5 * _ALIKE * float(alpha @ u.square().sum(1)))
    return float(fit.coefficients[0]), fit.coefficients[1:], hessian + 0.5 * (change + change.mT)


@dataclass(frozen=True)
class _Affine:
    """An affine function fitted to values. Their deviations from it are a Gaussian process."""

    factor: Tensor
    """Cholesky factor of the covariance of the deviations [P, P]."""
    coefficients: Tensor
    """[n + 1]"""
    left: Tensor
    """Deviations of the values less the earlier Hessian, divided by the factor [P]."""
    likelihood: float
    """Logarithm of the restricted likelihood of the values, not of the `rest`, at the likeliest scale."""

    @classmethod
    def through(cls, u: Tensor, values: Tensor, rest: Tensor, bend: Tensor, cubic: float) -> "_Affine":
        """Fit values [P] at u [P, n], for the likelihood, and the `rest` of them less the earlier Hessian [P].

        bend: u.H u [P] of the Hessian H whose multiple the change has.
        """
        P, n = u.shape
        factor = _factor(u, cubic, _ALIKE, bend)
        columns = torch.cat([u.new_ones(P, 1), u, rest[:, None], values[:, None]], 1)
        design, targets = torch.linalg.solve_triangular(factor, columns, upper=False).split([n + 1, 2], 1)
        free = (_FREE * float(design.square().sum(0).amax())) ** 0.5
        q, r = torch.linalg.qr(torch.cat([design, free * torch.eye(n + 1, dtype=u.dtype, device=u.device)]))
        found = torch.linalg.solve_triangular(r, q[:P].mT @ targets, upper=True)
        left, own = (targets - design @ found).unbind(1)
        degrees = max(P - n - 1, 1)
        variance = max(float(own.square().sum()) / degrees, torch.finfo(u.dtype).tiny)
        volume = float(factor.diagonal().log().sum() + r.diagonal().abs().log().sum())
        return cls(factor, found[:, 0], left, -0.5 * degrees * math.log(variance) - volume)


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


def _factor(u: Tensor, cubic: float, alike: float = 0.0, bend: Tensor | None = None) -> Tensor:
    """Return the Cholesky factor of the covariance of values at u [P, n] whose slopes and constant are subtracted."""
    inner = u @ u.mT
    kernel, squares = 0.5 * inner.square(), inner.diagonal()
    unit = float(kernel.diagonal().mean()) or 1.0
    kernel.addr_(squares, squares, alpha=0.25 * alike)
    if bend is not None:
        kernel.addr_(bend, bend, alpha=0.25)
    kernel.diagonal().add_(_EXACT * unit + cubic * squares.pow(3))
    return torch.linalg.cholesky(kernel)
