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
rate: quadratics through far points fit them nearly always, and the slopes of these quadratics are wrong. By the same
likelihoods, losses may choose a transform (`LossTransform`).
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torch_zerohess.surrogates.loss_transform import LossTransform, transformed
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


def least_change(
    u: Tensor, values: Tensor, hessian: Tensor, shared: "Interpolation | None" = None
) -> tuple[float, Tensor, Tensor]:
    """Return value, gradient [n] and Hessian [n, n] at u = 0 of the quadratic of least change.

    Args:
        u: points [P, n], of the order of 1.
        values: [P], of the order of 1.
        hessian: the earlier one [n, n].
        shared: of these points, if other values at them are interpolated, too.

    With fewer than n + 1 points the gradient has the least norm. With more points than a quadratic has coefficients the
    result is a regression. Near points count more than far ones, and much more where the points are few or where the
    likelihood of the values says so.
    """
    deviations, _ = _likeliest(shared or Interpolation(u), values[:, None], values.new_zeros(1), hessian)
    return deviations.quadratic(values, hessian)


def least_change_of_transform(
    u: Tensor,
    values: Tensor,
    hessian: Tensor,
    earlier: LossTransform | None,
    shared: "Interpolation | None" = None,
) -> tuple[LossTransform, Tensor, Tensor]:
    """Return the likeliest transform of losses, and gradient [n] and Hessian [n, n] at u = 0 of the transformed losses.

    Args:
        u: points [P, n], of the order of 1; the best one is 0.
        values: losses [P] above the lowest one, the largest of the order of 1.
        hessian: the earlier one [n, n].
        earlier: transform of the losses whose Hessian this is; None if it is of the losses themselves.
        shared: of these points, if other values at them are interpolated, too.
    """
    transforms, columns, slopes = transformed(values)
    deviations, k = _likeliest(shared or Interpolation(u), columns, slopes, hessian)
    if earlier is not None:
        hessian = transforms[k].hessian_ratio(earlier) * hessian
    _, gradient, hessian = deviations.quadratic(columns[:, k], hessian)
    return transforms[k], gradient, hessian


class Interpolation:
    """What quadratics of least change share that interpolate values at the same points u [P, n]."""

    def __init__(self, u: Tensor) -> None:
        self.u = u
        few = len(u) < _FEW * coefficient_count(u.shape[1])
        self.rates = {_OF_FEW: 0.0} if few else {_CUBIC: 0.0, _ROUGH: -math.log(_LIKELIER)}
        """Rates of growth of the variances to choose from, and the logarithms of their prior probabilities."""
        self._kept: list[_Deviations] = []

    def processes(self, hessian: Tensor) -> list["_Deviations"]:
        """Return the process of each rate. Up to four parameters the earlier Hessian changes none of them."""
        if not self._kept or self.u.shape[1] > _TOLD:
            bend = _curved(self.u, _multiple(hessian))
            self._kept = [_Deviations.of(self.u, bend, rate) for rate in self.rates]
        return self._kept


def _likeliest(shared: Interpolation, columns: Tensor, slopes: Tensor, hessian: Tensor) -> tuple["_Deviations", int]:
    """Return the likeliest process of deviations, and for which column of values [P, T] it is.

    slopes: the mean logarithms [T] of dy/dv, where the columns y are functions of values v.
    """
    P, n = shared.u.shape
    processes = shared.processes(hessian)
    degrees = max(P - n - 1, 1)  # the slopes count as often as values do that the affine function leaves free
    likelihoods = torch.stack([one.likelihood(columns) + degrees * slopes for one in processes])
    likelihoods += likelihoods.new_tensor(list(shared.rates.values()))[:, None]
    process, column = divmod(int(likelihoods.argmax()), columns.shape[1])
    return processes[process], column


def _multiple(hessian: Tensor) -> Tensor:
    """Return the multiple [n, n] of the earlier Hessian whose factor is a normal number of variance 1."""
    n = len(hessian)
    return ((_SCALED * n) ** 0.5 / (float(hessian.norm()) or 1.0) if n > _TOLD else 0.0) * hessian


def _curved(u: Tensor, hessian: Tensor) -> Tensor:
    """Return u.H u [P]."""
    return ((u @ hessian) * u).sum(1)


@dataclass(frozen=True)
class _Deviations:
    """The Gaussian process of the deviations of values from an affine function."""

    u: Tensor
    """Points [P, n]."""
    factor: Tensor
    """Cholesky factor of the covariance of the deviations [P, P]."""
    design: Tensor
    """Affine functions at the points, divided by the factor [P, n + 1]."""
    q: Tensor
    """Of the QR decomposition of the design and of the prior, the rows of the points [P, n + 1]."""
    r: Tensor
    """[n + 1, n + 1]"""

    @classmethod
    def of(cls, u: Tensor, bend: Tensor, cubic: float) -> "_Deviations":
        """Return the process at points [P, n]; bend [P] is u.H u of the Hessian whose multiple the change has."""
        P, n = u.shape
        factor = _factor(u, cubic, _ALIKE, bend)
        design = torch.linalg.solve_triangular(factor, torch.cat([u.new_ones(P, 1), u], 1), upper=False)
        free = (_FREE * float(design.square().sum(0).amax())) ** 0.5
        q, r = torch.linalg.qr(torch.cat([design, free * torch.eye(n + 1, dtype=u.dtype, device=u.device)]))
        return cls(u, factor, design, q[:P], r)

    def affine(self, columns: Tensor) -> tuple[Tensor, Tensor]:
        """Return coefficients [n + 1, T] of columns of values [P, T], and the rest divided by the factor [P, T]."""
        targets = torch.linalg.solve_triangular(self.factor, columns, upper=False)
        found = torch.linalg.solve_triangular(self.r, self.q.mT @ targets, upper=True)
        return found, targets - self.design @ found

    def likelihood(self, columns: Tensor) -> Tensor:
        """Return logarithms [T] of the restricted likelihood of columns of values [P, T], at their likeliest scales.

        They are not of the values less the earlier Hessian: this Hessian may be wrong.
        """
        degrees = max(len(self.u) - len(self.r), 1)
        variances = (self.affine(columns)[1].square().sum(0) / degrees).clamp(min=torch.finfo(columns.dtype).tiny)
        volume = self.factor.diagonal().log().sum() + self.r.diagonal().abs().log().sum()
        return -0.5 * degrees * variances.log() - volume

    def quadratic(self, values: Tensor, hessian: Tensor) -> tuple[float, Tensor, Tensor]:
        """Return value, gradient and Hessian of the quadratic of values [P], given the earlier Hessian [n, n]."""
        u, multiple = self.u, _multiple(hessian)
        coefficients, left = self.affine((values - 0.5 * _curved(u, hessian))[:, None])
        alpha = torch.linalg.solve_triangular(self.factor.mT, left, upper=True)[:, 0]
        change = (u.mT * alpha) @ u + 0.5 * float(alpha @ _curved(u, multiple)) * multiple
        change.diagonal().add_(0.5 * _ALIKE * float(alpha @ u.square().sum(1)))
        return float(coefficients[0]), coefficients[1:, 0], hessian + 0.5 * (change + change.mT)


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
